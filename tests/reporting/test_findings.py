"""Findings of made-up views: a warm spot is found, placed and measured; what must not be read is none."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.reporting.findings import find, normalised
from thermosplat.thermography.certainty import REFLECTING, SMALL, Sure
from thermosplat.viewer.measuring import SearchedView

HEIGHT, WIDTH = 60, 80


def _measurer(values: np.ndarray, doubts: int = 0) -> Any:
    """Of a wall at z = 2 that two views see from the same place."""
    K = torch.tensor([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]])
    view = ViewTensors(torch.eye(4), K, WIDTH, HEIGHT)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    depth = np.full(values.shape, 2.0)
    points = np.stack([x / 40, y / 40, depth], axis=-1)
    frames = [SimpleNamespace(name=name) for name in ("a", "b")]
    seen = [SearchedView(frame, view, values, depth, points) for frame in frames]
    sure = Sure(np.full(values.shape, 0.3), np.full(values.shape, doubts, np.uint8))
    return SimpleNamespace(
        searched=lambda spectrum: iter(seen), renderer=SimpleNamespace(how_sure=lambda layer, view: sure)
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


def test_difference_at_1000_watts() -> None:
    """The example of IEC TS 62446-3: 16 K at 860 W/m² are 18.6 K."""
    assert round(normalised(16.0, 860.0), 1) == 18.6
