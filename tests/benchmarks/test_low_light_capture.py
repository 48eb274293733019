"""Low-light copies: noise of the size that photons have, in photographs alone."""

import math
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from scenes.low_light_capture import darkened, low_light_copy
from thermosplat.datasets import load_capture

SAMPLE = Path(str(files("thermosplat").joinpath("sample")))


@pytest.mark.parametrize("electrons", [140.0, 2000.0])
def test_noise_is_that_of_photons_and_of_reading(electrons: float) -> None:
    """On an even grey the counted electrons have the variance of their mean and of the read noise."""
    grey = np.full((200, 200, 3), 186, dtype=np.uint8)
    noisy = darkened(grey, electrons, np.random.default_rng(1))
    counted = (noisy / 255.0) ** 2.2 * electrons
    mean = (186 / 255.0) ** 2.2 * electrons
    assert counted.mean() == pytest.approx(mean, rel=0.01)
    assert counted.std() == pytest.approx(math.sqrt(mean + 2.5**2), rel=0.03)


def test_copy_has_noise_in_photographs_alone(tmp_path: Path) -> None:
    """The ceiling is the PSNR of the clean held-out photographs; thermal images stay, to the byte."""
    clean = tmp_path / "clean"
    assert low_light_copy(SAMPLE, clean, None, shrink=2) == {}
    ceiling = low_light_copy(SAMPLE, tmp_path / "dark", 140.0, shrink=2)
    before, after = load_capture(clean), load_capture(tmp_path / "dark")
    found = []
    for frame, darker in zip(before.test, after.test, strict=True):
        assert darker.views["thermal"].path.read_bytes() == frame.views["thermal"].path.read_bytes()
        difference = frame.views["rgb"].pixels().image / 255.0 - darker.views["rgb"].pixels().image / 255.0
        found.append(-10.0 * math.log10(np.square(difference).mean()))
    assert ceiling == {"rgb": pytest.approx(np.mean(found))}
    assert 25.0 < ceiling["rgb"] < 30.0


def test_shrunk_copy_keeps_what_cameras_see(tmp_path: Path) -> None:
    """Images and cameras are a half, also of raw thermal values; the capture itself is left as it is."""
    low_light_copy(SAMPLE, tmp_path / "small", None, shrink=2)
    whole, small = load_capture(SAMPLE), load_capture(tmp_path / "small")
    for name in ("rgb", "thermal"):
        one, other = whole.train[0].views[name], small.train[0].views[name]
        assert (other.camera.width, other.camera.height) == (one.camera.width // 2, one.camera.height // 2)
        assert other.camera.fx == pytest.approx(one.camera.fx / 2)
    raw = sorted((tmp_path / "small" / "thermal_raw").glob("*.png"))
    assert len(raw) == len(small.test)
    assert cv2.imread(str(raw[0]), cv2.IMREAD_UNCHANGED).shape == (75, 100)
