"""The subcommands of thermosplat-prepare that deal with files: import, pair, check."""

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from thermosplat.cli.host_settings import importing
from thermosplat.cli.prepare_steps import CaptureArguments, capture_at, say, say_next
from thermosplat.errors import UserError


@dataclass(frozen=True)
class SourceArguments:
    """Which files a capture is made of, and where it is written."""

    folder: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")] = ""
    """Folder with the photographs and the thermal files, at any depth."""
    out: str = ""
    """Folder of the capture. None: captures/<name of FOLDER>."""

    @property
    def capture_folder(self) -> str:
        """Where the capture is written.

        Raises:
            UserError: No folder was named.
        """
        if self.out:
            return self.out
        if not self.folder:
            raise UserError("No folder given.", "Say where the files are: thermosplat-prepare FOLDER")
        return str(Path("captures") / Path(os.path.abspath(os.path.expanduser(self.folder))).name)


@dataclass(frozen=True)
class ImportArguments(SourceArguments):
    """Find photographs and thermal files, and turn thermal files into values with a unit."""

    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class PairArguments(CaptureArguments):
    """Find which thermal image was taken with which photograph."""


@dataclass(frozen=True)
class CheckArguments(CaptureArguments):
    """Say what the capture has and what may go wrong, and make a page to look at."""


def run_import(arguments: ImportArguments) -> int:
    """``thermosplat-prepare import``; returns the exit code."""
    root = Path(arguments.capture_folder)
    import_source(arguments, root)
    say_next("prepare pair", capture_at(root))
    return 0


def import_source(arguments: SourceArguments, root: Path) -> None:
    """Import what the arguments name into a capture's folder, and say what was found."""
    with importing():
        from thermosplat.prepare.import_files import import_files

    say("import", import_files(Path(os.path.expanduser(arguments.folder)), capture_at(root)))


def run_pair(arguments: PairArguments) -> int:
    """``thermosplat-prepare pair``; returns the exit code."""
    with importing():
        from thermosplat.prepare.pairing import pair_frames

    capture = capture_at(arguments.capture)
    say("pair", pair_frames(capture))
    say_next("prepare sfm", capture)
    return 0


def run_check(arguments: CheckArguments) -> int:
    """``thermosplat-prepare check``; returns the exit code."""
    with importing():
        from thermosplat.prepare.check import check

    capture = capture_at(arguments.capture)
    say("check", check(capture))
    print(f"Look at {shlex.quote(str(capture.check / 'index.html'))}")
    say_next("train", capture)
    return 0
