"""thermosplat-prepare: from the files of two cameras to a capture, in one command or step by step."""

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from thermosplat.cli import prepare_cameras, prepare_files
from thermosplat.cli.host_settings import importing
from thermosplat.cli.prepare_steps import capture_at, say
from thermosplat.cli.program import run_program


@dataclass(frozen=True)
class PrepareArguments(prepare_files.SourceArguments):
    """Make a capture of a folder with photographs and thermal files: all steps, one after the other.

    A step that is complete is not done again, so the same command goes on after an interruption.

    Steps (each has --help):
      thermosplat-prepare import FOLDER --out CAPTURE    find the files; temperatures with a unit
      thermosplat-prepare pair CAPTURE                   which thermal image belongs to which photograph
      thermosplat-prepare calibrate CAPTURE              lenses and the pose between the cameras, from a board
      thermosplat-prepare sfm CAPTURE                    camera poses of the photographs
      thermosplat-prepare register CAPTURE               the thermal camera, from the scene itself
      thermosplat-prepare check CAPTURE                  what may go wrong; a page to look at

    Examples:
      thermosplat-prepare data/shed
      thermosplat-prepare --rgb data/shed/photos --thermal data/shed/flir --out captures/shed
    """

    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


STEPS: dict[str, tuple[type[Any], Callable[[Any], int]]] = {
    "import": (prepare_files.ImportArguments, prepare_files.run_import),
    "pair": (prepare_files.PairArguments, prepare_files.run_pair),
    "calibrate": (prepare_cameras.CalibrateArguments, prepare_cameras.run_calibrate),
    "sfm": (prepare_cameras.SfmArguments, prepare_cameras.run_sfm),
    "register": (prepare_cameras.RegisterArguments, prepare_cameras.run_register),
    "check": (prepare_files.CheckArguments, prepare_files.run_check),
}
"""Arguments and body of each subcommand."""


def main(argv: list[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: Arguments without the program's name. None: the process's.

    Returns:
        The exit code.
    """
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in STEPS:
        arguments, body = STEPS[words[0]]
        return run_program(arguments, body, words[1:], prog=f"thermosplat-prepare {words[0]}")
    return run_program(PrepareArguments, _prepare, words, prog="thermosplat-prepare")


def _prepare(arguments: PrepareArguments) -> int:
    root = Path(arguments.capture_folder)
    prepare_files.import_source(arguments, root)
    with importing():
        from thermosplat.prepare.check import check
        from thermosplat.prepare.pairing import pair_frames

    capture = capture_at(root)
    say("pair", pair_frames(capture))
    prepare_cameras.find_cameras(capture)
    say("check", check(capture))
    print(f"Next: thermosplat-train {shlex.quote(str(root))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
