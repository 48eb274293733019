"""The subcommands of thermosplat-prepare that find cameras: calibrate, sfm, register."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from thermosplat.cli.command_line import check_ranges
from thermosplat.cli.host_settings import WITHOUT_TORCH, importing
from thermosplat.cli.preparing.steps import CaptureArguments, capture_at, say, say_next
from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.prepare.capture_folder import CaptureFolder


@dataclass(frozen=True)
class CalibrateArguments(CaptureArguments):
    """Find lenses and the pose between the cameras from pictures of a board."""

    rgb: str = ""
    """Folder with photographs of the board."""
    thermal: str = ""
    """Folder with thermal images of the board, taken at the same moments, in the same order of names."""
    board: Literal["checkerboard", "circles", "charuco"] = "checkerboard"
    """What is on it: squares, an asymmetric grid of circles, or a ChArUco board of the dictionary 5X5_100."""
    columns: int = 9
    """Inner corners per row of a checkerboard, circles per row, or squares per row of a ChArUco board."""
    rows: int = 6
    """Rows of these."""
    size: float = 0.03
    """Side of a square [m]; of circles, half the distance between neighbours of a row."""
    marker: float = 0.022
    """Side of a ChArUco marker [m]."""


@dataclass(frozen=True)
class SfmArguments(CaptureArguments):
    """Find the camera poses of the photographs (structure from motion)."""

    mapper: Literal["auto", "incremental", "global"] = "auto"
    """COLMAP's mapper: one photograph after the other, or all at once; auto tries the second where the first fails."""


@dataclass(frozen=True)
class RegisterArguments(CaptureArguments):
    """Find the thermal camera's lens and its place beside the photographs', from the scene itself."""


def run_calibrate(arguments: CalibrateArguments) -> int:
    """``thermosplat-prepare calibrate``; returns the exit code."""
    if not arguments.rgb or not arguments.thermal:
        raise UserError(
            "calibrate needs two folders with pictures of a board.",
            "Name them: thermosplat-prepare calibrate CAPTURE --rgb BOARDS/rgb --thermal BOARDS/thermal",
        )
    check_ranges(arguments, columns=(3, 100), rows=(3, 100), size=(1e-6, 1e6), marker=(1e-6, 1e6))
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.calibration.boards import Board
        from thermosplat.prepare.calibration.calibrate import calibrate

    capture = capture_at(arguments.capture)
    board = Board(arguments.board, arguments.columns, arguments.rows, arguments.size, arguments.marker)
    say("calibrate", calibrate(capture, Path(arguments.rgb).expanduser(), Path(arguments.thermal).expanduser(), board))
    say_next("prepare sfm", capture)
    return 0


def run_sfm(arguments: SfmArguments) -> int:
    """``thermosplat-prepare sfm``; returns the exit code."""
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.structure.sfm import run_sfm as step

    capture = capture_at(arguments.capture)
    say("sfm", step(capture, mapper=arguments.mapper))
    say_next("prepare register", capture)
    return 0


def run_register(arguments: RegisterArguments) -> int:
    """``thermosplat-prepare register``; returns the exit code."""
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.registration.register import register

    capture = capture_at(arguments.capture)
    say("register", register(capture))
    say_next("prepare check", capture)
    return 0


def find_cameras(capture: "CaptureFolder") -> None:
    """The steps between pairing and checking, of ``thermosplat-prepare FOLDER``: sfm, then register."""
    with importing(WITHOUT_TORCH):
        from thermosplat.prepare.capture_folder import OTHER
        from thermosplat.prepare.registration.register import register
        from thermosplat.prepare.structure.sfm import run_sfm

    say("sfm", run_sfm(capture))
    if capture.read_frames(OTHER):
        say("register", register(capture))
    else:
        print("register: left out, because there are no thermal images.")
