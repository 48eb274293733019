"""The subcommands of thermosplat-prepare that find cameras: calibrate, sfm, register."""

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from thermosplat.cli.host_settings import importing
from thermosplat.cli.prepare_steps import CaptureArguments, capture_at, say
from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.prepare.capture_folder import CaptureFolder


@dataclass(frozen=True)
class CalibrateArguments(CaptureArguments):
    """Find lenses and the pose between the cameras from pictures of a board."""


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
    raise _not_yet("calibrate")


def run_sfm(arguments: SfmArguments) -> int:
    """``thermosplat-prepare sfm``; returns the exit code."""
    with importing():
        from thermosplat.prepare.sfm import run_sfm as step

    capture = capture_at(arguments.capture)
    say("sfm", step(capture, mapper=arguments.mapper))
    print(f"Next: thermosplat-prepare register {shlex.quote(str(capture.root))}")
    return 0


def run_register(arguments: RegisterArguments) -> int:
    """``thermosplat-prepare register``; returns the exit code."""
    with importing():
        from thermosplat.prepare.register import register

    capture = capture_at(arguments.capture)
    say("register", register(capture))
    print(f"Next: thermosplat-prepare check {shlex.quote(str(capture.root))}")
    return 0


def find_cameras(capture: "CaptureFolder") -> None:
    """The steps between pairing and checking, of ``thermosplat-prepare FOLDER``: sfm, then register."""
    with importing():
        from thermosplat.prepare.register import register
        from thermosplat.prepare.sfm import run_sfm

    say("sfm", run_sfm(capture))
    say("register", register(capture))


def _not_yet(step: str) -> UserError:
    return UserError(f"thermosplat-prepare {step} is not in this version yet.", "Use COLMAP; docs/data-layouts.md.")
