"""What is said where thermal images of another hour cannot be placed."""

from pathlib import Path

import pycolmap
import pytest

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder, FrameRow
from thermosplat.prepare.placing.place_step import place_unpaired


def test_without_positions_nothing_is_searched(tmp_path: Path) -> None:
    """The message says how many images have one, and where positions come from."""
    capture = CaptureFolder(tmp_path)
    capture.write_frames([FrameRow("thermal", f"{number}.png", f"{number}", 320, 240) for number in range(14)])
    with pytest.raises(UserError, match=r"0 of 14 thermal images .* GPS position") as raised:
        place_unpaired(capture, pycolmap.Reconstruction())
    assert "gps.csv" in str(raised.value.hint)
