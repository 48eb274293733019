"""Lenses and rig from boards, against the cameras that the boards were drawn with."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from seen_boards import true_rig, write_boards
from thermosplat.errors import UserError
from thermosplat.prepare.calibration.boards import Board, find_board
from thermosplat.prepare.calibration.calibrate import calibrate
from thermosplat.prepare.calibration.calibration_file import read_calibration
from thermosplat.prepare.capture_folder import CaptureFolder

CHECKERBOARD = Board("checkerboard", 8, 6, 0.04)
BOARDS = [CHECKERBOARD, Board("circles", 4, 9, 0.035), Board("charuco", 9, 6, 0.05, 0.038)]


@pytest.mark.rotating
@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_lenses_and_rig_are_those_of_the_cameras(board: Board, tmp_path: Path) -> None:
    """Thermal focal length to 0.2%, rotation to 0.05°, translation to 1 mm; dark squares are warm."""
    capture, truth = CaptureFolder(tmp_path / "capture"), true_rig()
    rgb, thermal = write_boards(tmp_path / "boards", truth, board)
    report = calibrate(capture, rgb, thermal, board)
    found = read_calibration(capture.calibration_json)
    assert found is not None
    assert abs(found.thermal.params[0] / truth.thermal.params[0] - 1) < 0.002
    assert abs(found.rgb.params[0] / truth.rgb.params[0] - 1) < 0.002
    turn = cv2.Rodrigues(found.thermal_from_rgb[:3, :3] @ truth.thermal_from_rgb[:3, :3].T)[0]
    assert np.degrees(np.linalg.norm(turn)) < 0.05
    assert np.linalg.norm(found.thermal_from_rgb[:3, 3] - truth.thermal_from_rgb[:3, 3]) < 1e-3
    assert cv2.imread(str(capture.check / "calibration.png")).shape[1] == 640
    assert any("px in the thermal image" in sentence for sentence in report.sentences)


@pytest.mark.rotating("boards of other sizes")
def test_too_few_boards_are_counted(tmp_path: Path) -> None:
    """Another board than was stated: none is found, and the sentence says what was looked for."""
    rgb, thermal = write_boards(tmp_path / "boards", true_rig(), CHECKERBOARD, count=3)
    with pytest.raises(
        UserError, match=r"in \d of 3 photographs, in \d thermal images, and in both of [1-3] pairs; at least 5"
    ):
        calibrate(CaptureFolder(tmp_path / "capture"), rgb, thermal, CHECKERBOARD)
    with pytest.raises(UserError, match=r"checkerboard of 11x9 was found in 0 of 3 photographs"):
        calibrate(CaptureFolder(tmp_path / "capture"), rgb, thermal, Board("checkerboard", 11, 9, 0.03))
    assert not (tmp_path / "capture" / "calibration.json").exists()


@pytest.mark.rotating("boards of other sizes")
def test_a_board_of_other_numbers_is_told_at_once(tmp_path: Path) -> None:
    """Squares that were counted for corners: the message has the numbers, after a few of the images."""
    rgb, thermal = write_boards(tmp_path / "boards", true_rig(), CHECKERBOARD, count=4)
    with pytest.raises(UserError, match=r"show a checkerboard of 8x6 inner corners .* none of 9x7") as caught:
        calibrate(CaptureFolder(tmp_path / "capture"), rgb, thermal, Board("checkerboard", 9, 7, 0.04))
    assert "--columns 8 --rows 6" in str(caught.value.hint)


def test_boards_in_large_photographs(tmp_path: Path) -> None:
    """They are found at a smaller size, and lie where they do in the small photograph, to 0.25 px there."""
    rgb, _ = write_boards(tmp_path / "boards", true_rig(), CHECKERBOARD, count=1)
    image = cv2.imread(str(rgb / "00.png"), cv2.IMREAD_UNCHANGED)
    small, large = (find_board(one, CHECKERBOARD) for one in (image, cv2.resize(image, None, fx=3, fy=3)))
    assert small is not None
    assert large is not None
    enlarged = 3 * (small.pixels + 0.5) - 0.5
    nearest = np.linalg.norm(enlarged[:, None] - large.pixels[None], axis=-1).min(1)
    assert nearest.max() < 0.75


def test_folders_must_go_together(tmp_path: Path) -> None:
    """One thermal image is missing."""
    rgb, thermal = write_boards(tmp_path / "boards", true_rig(), CHECKERBOARD, count=2)
    (thermal / "01.png").unlink()
    with pytest.raises(UserError, match=r"has 2 images and .* has 1"):
        calibrate(CaptureFolder(tmp_path / "capture"), rgb, thermal, CHECKERBOARD)


def test_damaged_calibration_is_refused(tmp_path: Path) -> None:
    """A sentence, never a traceback."""
    path = tmp_path / "calibration.json"
    assert read_calibration(path) is None
    for content in ("no json", "[]", '{"rgb": {}, "thermal": {}, "thermal_from_rgb": []}'):
        path.write_text(content)
        with pytest.raises(UserError, match="is damaged"):
            read_calibration(path)
