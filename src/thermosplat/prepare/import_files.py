"""From what the cameras wrote to the images of a capture."""

from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.steps import StepReport


def import_files(folder: Path, capture: CaptureFolder) -> StepReport:
    """Find the files and write ``images/`` and ``frames.csv``."""
    raise UserError(f"thermosplat-prepare import {folder} --out {capture.root} is not in this version yet.")
