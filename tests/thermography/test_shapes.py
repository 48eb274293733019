"""Which pixels shapes cover, how large what they show is, and where regions are."""

import numpy as np
import pytest

from thermosplat.thermography.extents import area_of, points_at
from thermosplat.thermography.hot_regions import HotPixels, find_regions
from thermosplat.thermography.shapes import covered, outline

K = np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])


def test_a_line_has_its_pixels_in_order() -> None:
    """From one end to the other, without gaps."""
    rows, columns = covered("line", [(0.5, 5.9), (2.5, 0.3)], 10, 6)
    assert rows.tolist() == [5, 4, 3, 2, 1, 0]
    assert (columns[0], columns[-1]) == (0, 2)


@pytest.mark.parametrize("places", [[(2, 1), (4.5, 3.6)], [(4.5, 3.6), (2, 1)]])
def test_a_rectangle_covers_both_corners(places: list[tuple[float, float]]) -> None:
    """Whichever way it was drawn."""
    rows, columns = covered("rectangle", places, 10, 6)
    assert (rows.min(), rows.max(), columns.min(), columns.max(), len(rows)) == (1, 3, 2, 4, 9)


def test_ellipses_and_polygons_cover_their_areas() -> None:
    """As many pixels as their areas have; corners may go either way round, and a polygon may be hollow."""
    rows, _ = covered("ellipse", [(10, 10), (70, 50)], 80, 60)
    assert len(rows) == pytest.approx(np.pi * 30 * 20, rel=0.01)
    corners = [(10.0, 10.0), (50.0, 10.0), (50.0, 50.0), (30.0, 20.0)]
    for places in (corners, corners[::-1]):
        assert len(covered("polygon", places, 80, 60)[0]) == pytest.approx(600, rel=0.05)
    assert len(covered("polygon", [(5.1, 5.1), (5.2, 5.1), (5.2, 5.2)], 80, 60)[0]) == 1
    assert len(outline("ellipse", [(10, 10), (70, 50)])) > 8


@pytest.mark.parametrize("tilt", [0.0, 0.6, -1.0])
def test_the_area_of_a_plane(tilt: float) -> None:
    """A rectangle in the picture of a tilted, noisy plane has the area that its corners span."""
    places = [(20.0, 15.0), (59.9, 44.9)]
    x = np.tile((np.arange(80) + 0.5 - 40) / 100, (60, 1))
    depth = 3.0 / (1 - tilt * x)  # z = 3 + tilt·X
    corners = points_at(outline("rectangle", places), 3.0 / (1 - tilt * x), K, np.eye(4))
    sides = [corners[k] - corners[0] for k in (1, 2, 3)]
    true = (np.linalg.norm(np.cross(sides[0], sides[1])) + np.linalg.norm(np.cross(sides[1], sides[2]))) / 2
    noisy = depth * (1 + 0.003 * np.random.default_rng(0).standard_normal(depth.shape))
    found = area_of(covered("rectangle", places, 80, 60), noisy, K)
    assert found == pytest.approx(true, rel=0.06)


def test_the_area_of_what_is_not_flat() -> None:
    """Half a ball has most of the area of half a ball: its rim, which is seen edge-on, counts less."""
    x, y = np.meshgrid((np.arange(200) + 0.5 - 100) / 2000, (np.arange(200) + 0.5 - 100) / 2000)
    lens = np.array([[2000.0, 0, 100], [0, 2000.0, 100], [0, 0, 1]])
    distance, radius = 100.0, 4.0
    length = 1 + x**2 + y**2
    root = distance**2 - length * (distance**2 - radius**2)
    depth = np.where(root > 0, (distance - np.sqrt(np.maximum(root, 0))) / length, np.nan)
    found = area_of(covered("rectangle", [(0, 0), (199, 199)], 200, 200), depth, lens)
    assert found == pytest.approx(0.83 * 2 * np.pi * radius**2, rel=0.03)
    assert area_of(covered("spot", [(1, 1)], 200, 200), depth, lens) is None


def test_regions_are_joined_over_views() -> None:
    """Two patches, one of them seen from two views in parts that touch; the hottest comes first."""
    generator = np.random.default_rng(0)

    def patch(low: float, high: float, value: float, count: int = 400) -> HotPixels:
        points = np.stack(
            [generator.uniform(low, high, count), generator.uniform(0, 1, count), np.zeros(count)], axis=1
        )
        return HotPixels(points, np.full(count, value), np.full(count, (high - low) / count))

    first, other, far = patch(0.0, 1.0, 40.0), patch(0.9, 2.0, 41.0), patch(5.0, 5.5, 60.0)
    views = [first, HotPixels(*(np.concatenate(parts) for parts in zip(vars(other).values(), vars(far).values())))]
    hottest, joined = find_regions(views, 0.1)
    assert (hottest.extreme, joined.extreme) == (60.0, 41.0)
    assert (hottest.views, joined.views) == (1, 2)
    assert joined.size[0] == pytest.approx(2.0, abs=0.05)
    assert hottest.place[0] == pytest.approx(5.25, abs=0.05)
    assert hottest.area == pytest.approx(0.5)
    assert joined.best_view in (0, 1)
    assert find_regions([HotPixels(np.zeros((0, 3)), np.zeros(0), np.zeros(0))], 0.1) == []
    assert [one.extreme for one in find_regions([first, far], 0.1, colder=True)] == [40.0, 60.0]
