"""Large photographs are trained smaller, and it is said."""

from pathlib import Path

import pytest

from thermosplat.config import TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.config.values import fill
from thermosplat.datasets import image_size, load_capture
from thermosplat.datasets.image_size import TrainedSize
from thermosplat.errors import UserError


@pytest.mark.parametrize(
    ("factor", "longest", "size", "divisor"),
    [
        (1, "auto", (4000, 3000), 2.5),
        (1, "auto", (3000, 8064), 5.04),
        (1, "auto", (1600, 1200), 1.0),
        (1, "auto", (640, 512), 1.0),
        (2, "auto", (8000, 6000), 2.0),
        (1, 3000, (4000, 3000), 4 / 3),
        (2, 1000, (4000, 3000), 4.0),
        (4, 3000, (4000, 3000), 4.0),
    ],
)
def test_what_images_are_divided_by(factor: int, longest: int, size: tuple[int, int], divisor: float) -> None:
    """auto: 1,600 px on the longer side, unless a factor is given; a size holds with a factor, too."""
    assert TrainedSize(factor, longest).divisor(*size) == pytest.approx(divisor)


def test_a_capture_of_large_photographs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sides, intrinsics and a note; a spectrum whose images are small keeps them."""
    whole = load_capture("sample")
    monkeypatch.setattr(image_size, "LONGEST_SIDE", 160)
    capture = load_capture("sample")
    views, before = capture.train[0].views, whole.train[0].views
    assert (views["rgb"].camera.width, views["rgb"].camera.height) == (160, 120)
    assert views["rgb"].camera.fx == pytest.approx(0.8 * before["rgb"].camera.fx)
    assert views["rgb"].pixels().image.shape == (120, 160, 3)
    (note,) = [note for note in capture.notes if "--image-size" in note]
    assert "of 200x150 at 160x120" in note
    assert not any("--image-size" in note for note in whole.notes)
    told = load_capture("sample", image_size=100)
    assert told.train[0].views["rgb"].camera.width == 100
    assert not any("--image-size" in note for note in told.notes)


def test_the_setting_is_a_number_or_auto(tmp_path: Path) -> None:
    """Of a file or a flag."""
    assert fill(TrainConfig(), {"image_size": 2000}, source="x").image_size == 2000
    assert fill(TrainConfig(), {"image_size": "auto"}, source="x").image_size == "auto"
    with pytest.raises(UserError, match="image_size"):
        fill(TrainConfig(), {"image_size": "large"}, source="x")
    with pytest.raises(UserError, match=r"--image-size must be at least 1 or auto, found 0"):
        check_config(fill(TrainConfig(data="sample"), {"image_size": 0}, source="x"))
