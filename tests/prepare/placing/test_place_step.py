"""What is said where thermal images of another hour cannot be placed."""

from pathlib import Path

import pycolmap
import pytest

from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder, FrameRow
from thermosplat.prepare.placing.place_step import place_unpaired


def test_few_images_are_not_placed(tmp_path: Path) -> None:
    """The message says how many there are and how many it takes."""
    capture = CaptureFolder(tmp_path)
    capture.write_frames([FrameRow("thermal", f"{number}.png", f"{number}", 320, 240) for number in range(11)])
    with pytest.raises(UserError, match=r"11 thermal images of another hour.* from 12 on") as raised:
        place_unpaired(capture, pycolmap.Reconstruction())
    assert "thermosplat-prepare pair" in str(raised.value.hint)
