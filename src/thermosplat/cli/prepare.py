"""thermosplat-prepare: from the files of two cameras to a capture, in one command or step by step."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from thermosplat.cli.host_settings import WITHOUT_TORCH, importing
from thermosplat.cli.preparing import cameras, files
from thermosplat.cli.preparing.steps import capture_at, say, say_next
from thermosplat.cli.program import run_program


@dataclass(frozen=True)
class PrepareArguments(files.SourceArguments):
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
      thermosplat-prepare data/day --thermal data/night
    """

    debug: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the traceback of an error."""


STEPS: dict[str, tuple[type[Any], Callable[[Any], int]]] = {
    "import": (files.ImportArguments, files.run_import),
    "pair": (files.PairArguments, files.run_pair),
    "calibrate": (cameras.CalibrateArguments, cameras.run_calibrate),
    "sfm": (cameras.SfmArguments, cameras.run_sfm),
    "register": (cameras.RegisterArguments, cameras.run_register),
    "check": (files.CheckArguments, files.run_check),
}
"""Arguments and body of each subcommand."""


def main(argv: list[str] | None = None) -> int:
    """Run the command with some words, or with the process's; the exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in STEPS:
        arguments, body = STEPS[words[0]]
        return run_program(arguments, _goes_on(body), words[1:], prog=f"thermosplat-prepare {words[0]}")
    return run_program(PrepareArguments, _goes_on(_prepare), words, prog="thermosplat-prepare")


def _goes_on(body: Callable[[Any], int]) -> Callable[[Any], int]:
    """A body that says what Ctrl-C leaves."""

    def told(arguments: Any) -> int:
        try:
            return body(arguments)
        except KeyboardInterrupt:
            print("What was done is kept. The same command goes on.", file=sys.stderr)
            raise

    return told


def _prepare(arguments: PrepareArguments) -> int:
    root = Path(arguments.capture_folder)
    files.import_source(arguments, root)
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.checking.check import check
        from thermosplat.prepare.pairing.pairing import pair_frames

    capture = capture_at(root)
    say("pair", pair_frames(capture, "none" if arguments.of_another_hour else "auto"))
    cameras.find_cameras(capture)
    say("check", check(capture))
    say_next("train", capture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
