"""Findings of made-up views: a warm spot is found, placed and measured; what must not be read is none."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.reporting import findings
from thermosplat.reporting.findings import find, normalised
from thermosplat.thermography.certainty import REFLECTING, SMALL, Sure
from thermosplat.viewer.measuring import SearchedView

HEIGHT, WIDTH = 60, 80


def _measurer(values: np.ndarray, doubts: int = 0) -> Any:
    """Of a wall at z = 2 that five views see from the same place, without photographs."""
    K = torch.tensor([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]])
    view = ViewTensors(torch.eye(4), K, WIDTH, HEIGHT)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    depth = np.full(values.shape, 2.0)
    points = np.stack([x / 40, y / 40, depth], axis=-1)
    frames = [SimpleNamespace(name=name) for name in "abcde"]
    seen = [SearchedView(frame, view, values, depth, points) for frame in frames]
    sure = Sure(np.full(values.shape, 0.3), np.full(values.shape, doubts, np.uint8))
    return SimpleNamespace(
        scene=SimpleNamespace(scales={}, frames=[]),
        searched=lambda spectrum, width, every: iter(seen),
        renderer=SimpleNamespace(how_sure=lambda layer, view, where, values: sure),
    )


def _wall(warm: float) -> np.ndarray:
    """A wall of 10 to 12 degrees with a spot of 8 x 10 pixels."""
    values = np.tile(np.linspace(10.0, 12.0, WIDTH), (HEIGHT, 1))
    values[20:28, 30:40] += warm
    return values


@pytest.mark.parametrize(("warm", "colder"), [(5.0, False), (-5.0, True)])
def test_a_spot_is_found(warm: float, colder: bool) -> None:
    """Its place, area, numbers and difference to what is around it; the slope of the wall is none."""
    found = find(_measurer(_wall(warm)), "thermal", limit=2.0, colder=colder)
    assert len(found.findings) == 1
    one = found.findings[0]
    assert one.region.place == pytest.approx(((35 - 40) / 40, (24 - 30) / 40, 2.0), abs=1e-6)
    assert one.area == pytest.approx(80 / 40**2, rel=0.02)
    assert one.difference == pytest.approx(warm, abs=0.1)
    assert one.mean == pytest.approx(_wall(warm)[20:28, 30:40].mean())
    assert one.uncertainty == pytest.approx(0.3)
    assert not find(_measurer(_wall(warm)), "thermal", limit=2.0, colder=not colder).findings


def test_a_measured_reference_and_the_limit_by_default() -> None:
    """Against one value all that is beyond it counts; without a limit the usual spread makes one."""
    assert find(_measurer(_wall(5.0)), "thermal", limit=2.0, reference=8.5).findings[0].area == pytest.approx(
        (np.linspace(10, 12, WIDTH) > 10.5).sum() * HEIGHT / 40**2, rel=0.15
    )
    found = find(_measurer(_wall(5.0)), "thermal", least=1.0)
    assert found.limit >= 1.0
    assert len(found.findings) == 1


@pytest.mark.parametrize(("doubts", "findings"), [(REFLECTING, 0), (SMALL, 1), (0, 1)])
def test_reflections_are_no_findings(doubts: int, findings: int) -> None:
    """What must not be read is counted, and left out; that something is small is no reason."""
    found = find(_measurer(_wall(5.0), doubts), "thermal", limit=2.0)
    assert (len(found.findings), found.not_read) == (findings, 1 - findings)


def test_a_hot_cell_is_apart_from_the_module_beside_it() -> None:
    """Noise beyond the limit connects them; the hotter one is found first, and each has its own place."""
    values = _wall(0.0)
    values[10:22, 20:32] += 9.0
    values[14:18, 44:48] += 18.0
    values[15:17, 32:44] += 2.5
    cell, module = find(_measurer(values), "thermal", limit=2.0).findings
    assert cell.difference == pytest.approx(18.0, abs=0.3)
    assert cell.area == pytest.approx(16 / 40**2, rel=0.05)
    assert module.region.place[0] == pytest.approx((26 - 40) / 40, abs=0.03)
    assert module.area == pytest.approx(12 * 12 / 40**2, rel=0.05)


def test_parts_of_a_pattern_are_one_finding() -> None:
    """Stripes that are alike, as rafters make them, are one finding; one that is much warmer is another."""
    values = _wall(0.0)
    for column in (20, 26, 32):
        values[10:30, column : column + 2] += 4.0
    values[40:50, 50:54] += 9.0
    found = find(_measurer(values), "thermal", limit=2.0).findings
    assert [round(one.difference) for one in found] == [9, 4]
    assert found[1].region.size[0] == pytest.approx(14 / 40, abs=0.05)
    assert found[1].area == pytest.approx(3 * 40 / 40**2, rel=0.1)


@pytest.mark.parametrize(("changes", "things"), [(0.3, 1), (0.01, 0)])
def test_things_are_alone_of_their_colour(monkeypatch: pytest.MonkeyPatch, changes: float, things: int) -> None:
    """A warm chimney is listed beside the findings; heat under paint of one colour is a finding."""
    values, photograph = _wall(0.0), np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    values[20:26, 30:36] += 5.0
    photograph[20:26, 30:36] += changes
    monkeypatch.setattr(findings, "photographs_of", lambda measurer, views: [photograph] * len(views))
    found = find(_measurer(values), "thermal", limit=2.0)
    assert (len(found.things), len(found.findings)) == (things, 1 - things)


def test_a_hot_thing_is_apart_from_the_warm_one_around_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hottest part comes first, at its own place: a unit on a roof is not the roof's middle."""
    values, photograph = _wall(0.0), np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    values[20:26, 30:36] += 5.0
    values[20:24, 30:34] += 18.0
    photograph[20:26, 30:36] += 0.3
    monkeypatch.setattr(findings, "photographs_of", lambda measurer, views: [photograph] * len(views))
    unit, around = find(_measurer(values), "thermal", limit=2.0).things
    assert unit.region.place == pytest.approx(((32 - 40) / 40, (22 - 30) / 40, 2.0), abs=1e-6)
    assert around.region.place == pytest.approx(((33 - 40) / 40, (23 - 30) / 40, 2.0), abs=1e-6)


def test_half_of_many_views_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each second one, where there are many; they find what all find."""
    measurer = _measurer(_wall(5.0))
    every = list[int]()
    seen = list(measurer.searched("thermal", 0, 1)) * 2

    def searched(spectrum: str, width: int, each: int) -> Any:
        every.append(each)
        return iter(seen[::each])

    measurer.searched = searched
    measurer.scene.frames = [SimpleNamespace(views={"thermal": None})] * 10
    for many in (11, 10):
        monkeypatch.setattr(findings, "_MANY_VIEWS", many)
        assert len(find(measurer, "thermal", limit=2.0).findings) == 1
    assert every == [1, 2]


@pytest.mark.parametrize("spot", [0.0, 4.0])
@pytest.mark.parametrize(("width", "contrast"), [(30, 0.2), (14, 0.03)])
def test_a_surface_is_compared_with_its_like(
    monkeypatch: pytest.MonkeyPatch, width: int, contrast: float, spot: float
) -> None:
    """A warm strip of another colour, or of another shade, is none beside a cold one; a spot on the strip is one."""
    noise = np.random.default_rng(0).normal(0.5, 0.005, (HEIGHT, WIDTH, 3))
    values, photograph = _wall(0.0), noise.astype(np.float32)
    values[:, 30 : 30 + width] += 6.0
    photograph[:, 30 : 30 + width] += contrast
    values[20:28, 34:40] += spot
    monkeypatch.setattr(findings, "photographs_of", lambda measurer, views: [photograph] * len(views))
    found = find(_measurer(values), "thermal", limit=2.0).findings
    assert [round(one.difference) for one in found] == [4] * bool(spot)


def test_a_region_ends_where_half_of_its_difference_is_left() -> None:
    """A spot that fades out has the area of its half width, not that of all that is beyond the limit."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    apart = ((x - 40) ** 2 + (y - 30) ** 2) / (2 * 3.0**2)
    one = find(_measurer(_wall(0.0) + 20 * np.exp(-apart)), "thermal", limit=1.0).findings[0]
    beyond_half, beyond_limit = (2 * np.pi * np.log(ratio) * 9 / 40**2 for ratio in (2, 20))
    assert beyond_half <= one.area < beyond_limit / 3


def test_few_pixels_and_few_views_are_none() -> None:
    """Less than 3x3 pixels is noise."""
    values = _wall(0.0)
    values[20:22, 30:34] += 9.0
    assert not find(_measurer(values), "thermal", limit=2.0).findings


def test_difference_at_1000_watts() -> None:
    """The example of IEC TS 62446-3: 16 K at 860 W/m² are 18.6 K."""
    assert round(normalised(16.0, 860.0), 1) == 18.6
