"""What a capture has, and what may go wrong."""

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.steps import StepReport


def check(capture: CaptureFolder) -> StepReport:
    """Write ``check/``."""
    raise UserError(f"thermosplat-prepare check {capture.root} is not in this version yet.")
