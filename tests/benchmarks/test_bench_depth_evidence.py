"""At which depth images agree, and what a plane sweep finds."""

from pathlib import Path

import numpy as np
import pytest

from bench_depth_evidence import agreement, swept_span
from scenes.held_out_depths import HeldOut
from scenes.swept_depths import in_unit_range, neighbours, swept_depths
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


def with_images(xs: tuple[float, ...]) -> list[tuple[View, np.ndarray]]:
    """Views of the plane, and their images."""
    return [(view, in_unit_range(view)) for view in map(seen_from, xs)]


def test_images_agree_at_the_true_depth() -> None:
    """Errors there are those of sampling; beside it they are larger, the farther the more."""
    depth = np.full((HEIGHT, WIDTH), DEPTH)
    truth = GroundTruth({"rgb": depth.astype(np.float32)}, np.zeros((HEIGHT, WIDTH), np.uint8))
    one = HeldOut(seen_from(0.0), truth, depth, depth)
    training = with_images((-1.0, -0.6, 0.5, 0.9))
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
    assert len(agreement(one, depth, depth > 0, with_images((100.0,)))) == 0


def test_a_plane_sweep_finds_the_depth() -> None:
    """In the middle of the image, to the step of its hypotheses; a larger window does no harm on one plane."""
    found = swept_depths(seen_from(0.0), [seen_from(x) for x in (-1.0, -0.6, 0.5, 0.9)], 4.0, 20.0, (1, 5))
    assert set(found) == {1, 5}
    for depth in found.values():
        assert depth.shape == (HEIGHT, WIDTH)
        errors = np.abs(depth[4:-4, 16:32] - DEPTH) / DEPTH
        assert np.median(errors) < 0.01
    assert np.percentile(np.abs(found[5][4:-4, 16:32] - DEPTH), 95) <= np.percentile(
        np.abs(found[1][4:-4, 16:32] - DEPTH), 95
    )


def test_what_too_few_images_show_is_not_decided_by_them() -> None:
    """Two views are no neighbourhood: every depth is as bad, and the first one stays."""
    found = swept_depths(seen_from(0.0), [seen_from(0.5), seen_from(-0.5)], 4.0, 20.0, (3,))[3]
    np.testing.assert_allclose(found, 4.0)


def test_neighbours_look_the_same_way() -> None:
    """The nearest come first, at most ten; who looks back is none."""
    back = seen_from(0.1)
    back.viewmat[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    others = [seen_from(x) for x in np.linspace(0.2, 3.0, 15)]
    chosen = neighbours(seen_from(0.0), [*reversed(others), back])
    assert [view.name for view in chosen] == [view.name for view in others[:10]]


def test_a_sweep_spans_the_points_in_front() -> None:
    """From below the nearest to beyond the farthest, whatever lies behind the camera."""
    points = np.array([[0.0, 0.0, z] for z in (-5.0, *np.linspace(2.0, 10.0, 1001))])
    nearest, farthest = swept_span(seen_from(0.0), points)
    assert 0.7 * 2.0 <= nearest < 1.5
    assert 14.8 < farthest <= 15.0


@pytest.mark.parametrize("as_bytes", [False, True])
def test_images_are_in_unit_range(as_bytes: bool) -> None:
    """Whatever they are stored as."""
    image = in_unit_range(seen_from(0.0, as_bytes=as_bytes))
    assert image.dtype == np.float32
    assert 0.05 < image.min() < image.max() < 1.0
