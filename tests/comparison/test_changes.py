"""Places that changed between two dates: their area, what moved, and none where nothing did."""

import cv2
import numpy as np
import pytest

from thermosplat.comparison.changes import find_changes
from thermosplat.comparison.compare import changes_said
from thermosplat.comparison.dated_map import DatedMap

SIZE, PIXEL, SHIFT = 160, 0.05, -6.0


def shown(values: np.ndarray, heights: np.ndarray | None = None, *, noise: int, aside: float = 0.0) -> DatedMap:
    """A map with correlated noise of 0.1 K, moved by a part of a pixel; its intervals are three times too wide."""
    grain = cv2.GaussianBlur(np.random.default_rng(noise).normal(size=values.shape), (0, 0), 1.0)
    moved = cv2.warpAffine(
        values, np.array([[1, 0, aside], [0, 1, -aside]]), values.shape, borderMode=cv2.BORDER_REFLECT
    )
    made = moved + 0.1 * grain / grain.std()
    ground = np.zeros_like(values) if heights is None else heights
    return DatedMap(made.astype(np.float32), np.full(values.shape, 0.6), ground.astype(np.float32), None)


def houses() -> np.ndarray:
    """Warm roofs on a cool ground, with sharp edges."""
    values = np.full((SIZE, SIZE), 12.0)
    values[20:60, 20:80], values[90:140, 100:150] = 18.0, 9.0
    return values


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def test_nothing_changed_beside_the_weather() -> None:
    """A common shift is stated, and edges that lie a part of a pixel aside are no changes."""
    found = find_changes(shown(houses(), noise=1), shown(houses() + SHIFT, noise=2, aside=0.6), PIXEL)
    assert found.shift == pytest.approx(SHIFT, abs=0.05)
    assert not found.found


@pytest.mark.parametrize(("side", "kelvin"), [(30, 1.0), (30, -1.0), (5, 8.0), (5, -8.0)])
def test_a_place_that_became_warmer_or_colder(side: int, kelvin: float) -> None:
    """It is found once, with its sign, its area and its difference, however wide the intervals of either date are."""
    mask = np.zeros((SIZE, SIZE), bool)
    mask[70 : 70 + side, 20 : 20 + side] = True
    after = houses() + SHIFT + kelvin * mask
    (change,) = find_changes(shown(houses(), noise=1), shown(after, noise=2), PIXEL).found
    assert change.kind == ("warmer" if kelvin > 0 else "colder")
    assert overlap(change.mask, mask) > 0.6
    assert change.difference == pytest.approx(kelvin, abs=0.3 * abs(kelvin))


@pytest.mark.parametrize(("kelvin", "kinds"), [(0.5, []), (1.5, ["warmer"])])
def test_scenes_that_agree_to_a_tenth_of_their_intervals(kelvin: float, kinds: list[str]) -> None:
    """What two halves of a flight differ by on a module that reflects is no change: it lies within both intervals."""
    first, other = shown(houses(), noise=1), shown(houses(), noise=1)
    other.values[70:90, 20:40] += kelvin
    found = find_changes(first, other, PIXEL)
    assert [one.kind for one in found.found] == kinds


def test_a_car_that_moved_is_no_warmer_place() -> None:
    """It is one thing with two places; the ground that it warms around it is no change of its own."""
    before, after = houses(), houses() + SHIFT
    heights = np.zeros((2, SIZE, SIZE))
    for number, (values, left) in enumerate(((before, 10), (after, 60))):
        values[110:125, left : left + 30] += 15.0
        heights[number, 110:125, left : left + 30] = 1.4
    (change,) = find_changes(shown(before, heights[0], noise=1), shown(after, heights[1], noise=2), PIXEL).found
    assert change.kind == "moved"
    assert change.source == pytest.approx((117, 24), abs=2)
    assert change.middle == pytest.approx((117, 74), abs=2)
    assert change.height == pytest.approx(1.4, abs=0.1)


@pytest.mark.parametrize(("height", "kind"), [(3.0, "new"), (-3.0, "gone")])
def test_a_thing_that_is_new_or_gone(height: float, kind: str) -> None:
    """A scaffold; a common error of all heights is none."""
    heights, after = np.zeros((SIZE, SIZE)), houses()
    heights[30:60, 100:130] = height
    after[30:60, 100:130] += np.sign(np.arange(30) - 15) * 3.0  # warm and cold, as things are
    (change,) = find_changes(shown(houses(), noise=1), shown(after, heights + 2.0, noise=2), PIXEL).found
    assert change.kind == kind


def test_heights_without_anything_to_see_are_unsure() -> None:
    """Flat ground that looks as before has not risen."""
    heights = np.zeros((SIZE, SIZE))
    heights[30:60, 100:130] = 3.0
    assert not find_changes(shown(houses(), noise=1), shown(houses(), heights, noise=2), PIXEL).found


def test_another_season() -> None:
    """Where a third of the ground is hidden by leaves, that is said beside what was found."""
    heights, leaves = np.zeros((SIZE, SIZE)), houses()
    heights[:, : SIZE // 3] = 3.0
    leaves[:, : SIZE // 3] = 5.0 + 3.0 * (np.arange(SIZE) // 8 % 2)[:, None]
    found = find_changes(shown(houses(), noise=1), shown(leaves, heights, noise=2), PIXEL)
    assert "% of the surface has another height: leaves or snow" in changes_said("july", "march", found, "celsius")
    same = find_changes(shown(houses(), noise=1), shown(houses(), noise=2), PIXEL)
    assert "leaves" not in changes_said("july", "march", same, "celsius")


def test_dates_that_show_nothing_in_common() -> None:
    """No pixel is known in both: there is no shift and no change."""
    first, other = shown(houses(), noise=1), shown(houses(), noise=2)
    first.values[:, : SIZE // 2], other.values[:, SIZE // 2 :] = np.nan, np.nan
    found = find_changes(first, other, PIXEL)
    assert (found.shift, found.found) == (0.0, ())
