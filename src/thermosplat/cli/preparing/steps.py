"""What the subcommands of thermosplat-prepare have in common: which capture, and how a step's findings are printed."""

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from thermosplat.config.checks import check_text

if TYPE_CHECKING:
    from thermosplat.prepare.capture_folder import CaptureFolder
    from thermosplat.prepare.steps import StepReport


@dataclass(frozen=True)
class CaptureArguments:
    """A capture that is being prepared."""

    capture: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """Folder that ``thermosplat-prepare import`` made."""
    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


def capture_at(folder: str | Path) -> "CaptureFolder":
    """The capture in a folder; "~" is the home directory.

    Raises:
        UserError: The folder's name is not UTF-8.
    """
    from thermosplat.prepare.capture_folder import CaptureFolder

    root = Path(os.path.expanduser(folder))
    check_text(root.resolve(), "The capture's folder")
    return CaptureFolder(root)


def say(step: str, report: "StepReport") -> None:
    """Print what a step found."""
    print(f"{step}: {'complete already.' if report.before else 'done.'}")
    for sentence in report.sentences:
        print(f"  {sentence}")


def say_next(step: str, capture: "CaptureFolder") -> None:
    """Print the command that comes after this step; of photographs alone, without the steps for thermal images."""
    from thermosplat.prepare.capture_folder import OTHER

    alone = capture.frames_csv.exists() and not capture.read_frames(OTHER)
    if alone and step == "prepare register":
        step = "prepare check"
    flags = " --without thermal" if alone and step == "train" else ""
    print(f"Next: thermosplat-{step} {shlex.quote(str(capture.root))}{flags}")
