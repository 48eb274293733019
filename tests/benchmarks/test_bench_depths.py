"""At which depth images agree."""

from pathlib import Path

import numpy as np
import pytest

from bench_depths import HeldOut, agreement, in_unit_range
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import View
from thermosplat.datasets.ground_truth import GroundTruth

WIDTH, HEIGHT, FOCAL, DEPTH = 48, 32, 40.0, 8.0


def seen_from(x: float, *, as_bytes: bool = False) -> View:
    """A textured plane at ``DEPTH``, from a camera that stands ``x`` to the right."""
    across, down = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    place = (across - WIDTH / 2) / FOCAL * DEPTH + x
    shade = 0.5 + 0.2 * np.sin(3.0 * place) + 0.2 * np.cos(0.3 * down + 1.7 * place)
    image = np.repeat(shade[..., None], 3, axis=-1).astype(np.float32)
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    camera = Camera(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    pixels = np.round(255 * image).astype(np.uint8) if as_bytes else image
    return View("rgb", f"{x}", Path(f"{x}.png"), camera, viewmat, pixels)


def test_images_agree_at_the_true_depth() -> None:
    """Errors there are those of sampling; beside it they are larger, the farther the more."""
    depth = np.full((HEIGHT, WIDTH), DEPTH)
    truth = GroundTruth({"rgb": depth.astype(np.float32)}, np.zeros((HEIGHT, WIDTH), np.uint8))
    one = HeldOut(seen_from(0.0), truth, depth, depth)
    training = [seen_from(x) for x in (-1.0, -0.6, 0.5, 0.9)]
    chosen = np.zeros((HEIGHT, WIDTH), bool)
    chosen[4:-4, 16:32] = True
    errors = [agreement(one, factor * depth, chosen, training).mean() for factor in (1.0, 1.02, 1.05, 1.1)]
    assert errors[0] < 1e-5
    assert errors == sorted(errors)
    assert errors[1] > 2 * errors[0]
    assert errors[3] > 10 * errors[0]


def test_pixels_that_no_training_view_shows_do_not_count() -> None:
    """A camera far to the side sees none of them."""
    depth = np.full((HEIGHT, WIDTH), DEPTH)
    truth = GroundTruth({"rgb": depth.astype(np.float32)}, np.zeros((HEIGHT, WIDTH), np.uint8))
    one = HeldOut(seen_from(0.0), truth, depth, depth)
    assert len(agreement(one, depth, depth > 0, [seen_from(100.0)])) == 0


@pytest.mark.parametrize("as_bytes", [False, True])
def test_images_are_in_unit_range(as_bytes: bool) -> None:
    """Whatever they are stored as."""
    image = in_unit_range(seen_from(0.0, as_bytes=as_bytes))
    assert image.dtype == np.float32
    assert 0.05 < image.min() < image.max() < 1.0
