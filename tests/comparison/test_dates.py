"""What is said of runs that cannot be compared."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from thermosplat.comparison import dates
from thermosplat.comparison.dates import in_one_frame, opened_dates
from thermosplat.comparison.shared_frame import SharedFrame, shared_frame
from thermosplat.datasets.geo_file import GeoFrame
from thermosplat.datasets.placement import WORLD
from thermosplat.errors import UserError
from thermosplat.export.maps.map_frame import MapFrame

HERE = GeoFrame(47.05, 8.3, 480.0, 0.5, 40)


@dataclass(frozen=True)
class SaidRun:
    """A run of which only the words count."""

    path: str
    units: dict[str, str | None]
    geo: GeoFrame | None = None
    ground: np.ndarray = field(default_factory=lambda: np.random.default_rng(0).uniform(-30, 30, (200, 3)))

    @property
    def directory(self) -> Any:
        return SimpleNamespace(path=Path(self.path))

    @property
    def scales(self) -> dict[str, Any]:
        kinds = {name: "scalar" if name == "thermal" else "photograph" for name in self.units}
        return {name: SimpleNamespace(measured_unit=unit, kind=kinds[name]) for name, unit in self.units.items()}

    @property
    def model(self) -> Any:
        return SimpleNamespace(spectra=list(self.units), placement=WORLD)

    def capture(self, data: str | None) -> Any:
        return SimpleNamespace(
            name=Path(self.path).name, geo=None, placement=WORLD, points=self.ground, train=(), test=()
        )


DEGREES = {"rgb": None, "thermal": "celsius"}


def opened(monkeypatch: pytest.MonkeyPatch, *runs: SaidRun, data: tuple[str, ...] = ()) -> Any:
    known = {run.path: run for run in runs}
    monkeypatch.setattr(dates, "load_run", lambda path, device: known[path])
    return opened_dates([run.path for run in runs], data)


@pytest.mark.parametrize(
    ("units", "said"),
    [
        ({"rgb": None, "thermal": None}, "b has not: it has no values of thermal"),
        ({"rgb": None}, "b has not: it has no values of thermal"),
        ({"rgb": None, "thermal": "reflectance"}, "b has not: its thermal images have reflectance"),
    ],
)
def test_dates_that_do_not_measure_the_same(monkeypatch: pytest.MonkeyPatch, units: dict[str, Any], said: str) -> None:
    """One without degrees, without thermal images, or with another unit."""
    with pytest.raises(UserError, match=said):
        opened(monkeypatch, SaidRun("a", DEGREES), SaidRun("b", units))


def test_a_first_date_without_degrees(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then nothing can be compared at all."""
    with pytest.raises(UserError, match="a has no degrees"):
        opened(monkeypatch, SaidRun("a", {"rgb": None, "thermal": None}), SaidRun("b", DEGREES))


def test_the_wrong_number_of_runs_or_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs at least, and a capture for each or for none."""
    with pytest.raises(UserError, match="Two runs or more"):
        opened(monkeypatch, SaidRun("a", DEGREES))
    with pytest.raises(UserError, match="--data names 1 captures, and there are 2 runs"):
        opened(monkeypatch, SaidRun("a", DEGREES), SaidRun("b", DEGREES), data=("there",))
    _, spectrum, photographs = opened(monkeypatch, SaidRun("a", DEGREES), SaidRun("b", DEGREES))
    assert (spectrum, photographs) == ("thermal", "rgb")


@pytest.mark.parametrize(
    ("there", "said"), [((47.05, 8.4), "7,[0-9]+ m apart"), ((47.05, 14.3), "different UTM zones")]
)
def test_two_places(there: tuple[float, float], said: str) -> None:
    """GPS tells them apart before any photograph is looked at."""
    first, other = SaidRun("a", DEGREES, HERE), SaidRun("b", DEGREES, GeoFrame(*there, 480.0, 0.5, 40))
    with pytest.raises(UserError, match=said):
        in_one_frame([(first, first.capture(None)), (other, other.capture(None))], "rgb")


def test_lengths_that_differ_though_both_are_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scale that is 8% wrong is said; without metres it is found and stated."""
    found = SharedFrame(MapFrame(np.eye(3), 1.08, np.zeros(3)), 0.04, 5000)
    monkeypatch.setattr(dates, "shared_frame", lambda *arguments: found)
    runs = [SaidRun("a", DEGREES, HERE), SaidRun("b", DEGREES, HERE)]
    with pytest.raises(UserError, match=r"1\.080 times as long"):
        in_one_frame([(run, run.capture(None)) for run in runs], "rgb")
    local = [replace(run, geo=None) for run in runs]
    made, said = in_one_frame([(run, run.capture(None)) for run in local], "rgb")
    assert made[1].to_first.scale == 1.08
    assert "Lengths of b are 1.08 times as long in a" in said[0]


def test_photographs_with_nothing_in_common() -> None:
    """Two places without GPS, or two seasons."""
    runs = [SaidRun("a", DEGREES), SaidRun("b", DEGREES)]
    with pytest.raises(UserError, match="photographs of b and a show nothing in common"):
        shared_frame(*[(run, run.capture(None)) for run in runs], "rgb")
