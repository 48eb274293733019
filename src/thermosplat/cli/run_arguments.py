"""What the commands that read a trained run have in common: which run, and where its capture and device are."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Annotated

import tyro

from thermosplat.errors import UserError
from thermosplat.spectra import label, listed


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


@dataclass(frozen=True)
class SpectraArguments:
    """Which spectra of a run are shown."""

    spectra: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--modality"])] = ()
    """Spectra, such as rgb thermal. None: all that were trained."""

    def chosen(self, trained: Collection[str]) -> list[str]:
        """The spectra to show, in the order of the model.

        Raises:
            UserError: One was not trained.
        """
        for name in self.spectra:
            if name not in trained:
                raise UserError(
                    f"The run was trained on {listed(list(trained))} images, not on {label(name)}.",
                    f"Give --spectra {' '.join(trained)}.",
                )
        return [name for name in trained if name in self.spectra or not self.spectra]
