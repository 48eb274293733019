"""A plane sweep of a scene whose depths are known."""

import dataclasses

import pytest
import torch

from slanted_plane import plane_points, plane_views
from thermosplat.training.swept_depths import plane_sweep
from thermosplat.training.swept_depths.plane_sweep import SweptView, neighbors, swept_depths


def test_finds_the_plane() -> None:
    """Away from the border, where windows are whole, depths are exact to half a percent in the median."""
    views, depths = plane_views(5)
    swept = [SweptView.of(view) for view in views]
    found = swept_depths(swept[2], swept, plane_points())
    error = ((found - depths[2]).abs() / depths[2])[8:-8, 8:-8]
    assert error.median() < 0.005
    assert error.quantile(0.9) < 0.02


def test_brightness_is_the_scalar_where_there_is_one() -> None:
    """Pseudo-colours are compared by what they stand for."""
    view = plane_views(1)[0][0]
    intensity = torch.rand(view.height, view.width)
    looks = SweptView.of(dataclasses.replace(view, intensity=intensity)).looks
    assert torch.equal(looks[0], intensity)
    assert looks[1, 3, 5] == pytest.approx((intensity[3, 6] - intensity[3, 4]).item() / 2)
    assert looks[2, 3, 5] == pytest.approx((intensity[4, 5] - intensity[2, 5]).item() / 2)


def test_large_images_are_shrunk(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a large image is swept at has the same rays through its corners, and finds the same plane."""
    monkeypatch.setattr(plane_sweep, "MOST_PIXELS", 64 * 48)
    views, _ = plane_views(5, scale=2)
    swept, small = [SweptView.of(view) for view in views], plane_views(5)[1]
    assert swept[0].size == (48, 64)
    found = swept_depths(swept[2], swept, plane_points())
    error = ((found - small[2]).abs() / small[2])[8:-8, 8:-8]
    assert error.median() < 0.005


def test_too_few_views_say_nothing() -> None:
    """With two others, or where no other looks, there is no depth."""
    views, _ = plane_views(5)
    swept = [SweptView.of(view) for view in views]
    assert not swept_depths(swept[0], swept[:3], plane_points()).any()
    assert not swept_depths(swept[0], swept, -plane_points()).any()  # all points are behind the cameras
    away = [dataclasses.replace(one, viewmat=one.viewmat.clone()) for one in swept[1:]]
    for one in away:
        one.viewmat[0, 3] += 1e3
    assert not swept_depths(swept[0], [swept[0], *away], plane_points()).any()


def test_neighbors_are_near_and_look_the_same_way() -> None:
    """The nearest first, without the view itself and those that look elsewhere."""
    swept = [SweptView.of(view) for view in plane_views(5)[0]]
    turned = dataclasses.replace(swept[1], viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])))
    assert neighbors(swept[0], [*swept, turned], 2) == swept[1:3]


def test_views_of_other_sizes_take_part() -> None:
    """Images of two sizes are compared with each other."""
    views, depths = plane_views(6)
    large = plane_views(6, scale=2)[0]
    swept = [SweptView.of(view) for view in (*views[:3], *large[3:])]
    error = ((swept_depths(swept[2], swept, plane_points()) - depths[2]).abs() / depths[2])[8:-8, 8:-8]
    assert error.median() < 0.01
