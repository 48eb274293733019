"""What the commands that read a trained run have in common: which run, and where its capture and device are."""

from dataclasses import dataclass
from typing import Annotated

import tyro


@dataclass(frozen=True)
class RunArguments:
    """A checkpoint of a trained run."""

    run: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Result folder of thermosplat-train."""
    step: int | None = None
    """Checkpoint to take. None: the last one."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class RunOnCaptureArguments(RunArguments):
    """A checkpoint of a trained run, rendered from views of its capture."""

    data: str | None = None
    """Folder of the capture, if it has moved since the training."""
    device: str = "auto"
    """"cuda", "cuda:1", "cpu", or "auto": CUDA where there is a device."""
