"""Which thermal image was taken with which photograph."""

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.steps import StepReport


def pair_frames(capture: CaptureFolder) -> StepReport:
    """Write ``pairs.csv``."""
    raise UserError(f"thermosplat-prepare pair {capture.root} is not in this version yet.")
