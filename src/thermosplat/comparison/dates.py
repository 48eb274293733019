"""Runs of several dates, checked to be comparable and brought into the frame of the first."""

from collections.abc import Sequence

import numpy as np

from thermosplat.comparison.dated_map import Date
from thermosplat.comparison.shared_frame import SharedFrame, shared_frame
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import LoadedRun, load_run
from thermosplat.export.maps.georeference import located_frame
from thermosplat.export.maps.map_frame import MapFrame, map_extent
from thermosplat.spectra import CELSIUS, unit_label

_SCALES_APART = 0.03
"""Share by which lengths of two captures in metres may differ; GPS of a flight tells them to 1%."""
_ITSELF = MapFrame(np.eye(3), offset=np.zeros(3))


def opened_dates(
    folders: Sequence[str], captures: Sequence[str] = (), *, device: str = "auto"
) -> tuple[list[tuple[LoadedRun, Capture]], str, str | None]:
    """Read runs that can be compared.

    Args:
        folders: Result folders, the first date first.
        captures: Where their captures lie now; none: where they lay.
        device: As ``--device``.

    Returns:
        Runs with their captures, the spectrum whose values are compared, and that of the photographs.

    Raises:
        UserError: There are fewer than two, one cannot be read, or they do not measure the same.
    """
    if len(folders) < 2:
        raise UserError("Two runs or more are compared.", "Name them: thermosplat-compare BEFORE AFTER")
    if len(captures) not in (0, len(folders)):
        raise UserError(
            f"--data names {len(captures)} captures, and there are {len(folders)} runs.",
            "Name the capture of each run, in the same order.",
        )
    runs = [load_run(folder, device=device) for folder in folders]
    places: list[str | None] = list(captures) or [None] * len(runs)
    opened = [(run, run.capture(data)) for run, data in zip(runs, places)]
    spectrum = _measured(runs[0])
    unit = runs[0].scales[spectrum].measured_unit
    for run in runs[1:]:
        found = run.scales[spectrum].measured_unit if spectrum in run.scales else None
        if found != unit:
            has = f"its {spectrum} images have {unit_label(found)}" if found else f"it has no values of {spectrum}"
            raise UserError(
                f"{runs[0].directory.path} has {unit_label(str(unit))}, and {run.directory.path} has not: {has}.",
                "Train both on images with the same unit: docs/temperatures.md.",
            )
    shared = [name for name in runs[0].model.spectra if all(name in run.scales for run in runs)]
    photographs = next((name for name in shared if runs[0].scales[name].kind == "photograph"), None)
    return opened, spectrum, photographs


def _measured(run: LoadedRun) -> str:
    """The spectrum with temperatures, else with other values."""
    units = {name: scale.measured_unit for name, scale in run.scales.items() if scale.measured_unit is not None}
    if not units:
        raise UserError(
            f"{run.directory.path} has no degrees: nothing is measured in it, so no change of it can be told.",
            "Train on thermal images with degrees: docs/temperatures.md.",
        )
    return next((name for name, unit in units.items() if unit == CELSIUS), next(iter(units)))


def in_one_frame(opened: Sequence[tuple[LoadedRun, Capture]], spectrum: str) -> tuple[list[Date], list[str]]:
    """Bring the scenes into the frame of the first.

    Args:
        opened: Runs with their captures.

    Returns:
        The dates; and what to tell people.

    Raises:
        UserError: Two are of different places, show nothing in common, or disagree about lengths that are in metres.
    """
    first, names = opened[0], _names([capture.name for _, capture in opened])
    dates, said = [Date(names[0], *first, _ITSELF)], []
    geo = _located(*first)
    for name, other in zip(names[1:], opened[1:]):
        there = _located(*other)
        start = None if geo is None or there is None else _between(geo, there)
        if start is not None:
            _check_place(first, other, start, geo)
        found = shared_frame(first, other, spectrum, start)
        if start is not None and abs(found.to_first.scale / start.scale - 1) > _SCALES_APART:
            raise UserError(
                f"Both captures are in metres, and yet lengths of {other[0].directory.path} are "
                f"{found.to_first.scale / start.scale:.3f} times as long in {first[0].directory.path}: the scale of "
                "one of them is wrong.",
                "Look at what thermosplat-prepare sfm says of GPS in both, and prepare that capture again.",
            )
        said.append(_said(name, names[0], found, geo))
        dates.append(Date(name, *other, found.to_first))
    return dates, said


def _said(name: str, first: str, found: SharedFrame, geo: MapFrame | None) -> str:
    unit, scale = ("units", 1.0) if geo is None else ("m", geo.scale)
    lengths = "" if geo is not None else f" Lengths of {name} are {found.to_first.scale:.4g} times as long in {first}."
    return (
        f"{name} lies in the frame of {first}: {found.matches:,} points of photographs of both dates are "
        f"{found.residual * scale:.3g} {unit} apart in the median.{lengths}"
    )


def _names(wanted: list[str]) -> list[str]:
    """Different names; those that come twice are numbered."""
    if len(set(wanted)) == len(wanted):
        return wanted
    return [f"{number} {name}" for number, name in enumerate(wanted, 1)]


def _located(run: LoadedRun, capture: Capture) -> MapFrame | None:
    geo = run.geo or capture.geo
    return None if geo is None else located_frame(geo, capture.placement)


def _between(first: MapFrame, other: MapFrame) -> MapFrame:
    """From the scene of the other frame to that of the first."""
    offset = np.zeros(3) if other.offset is None else other.offset
    return MapFrame(first.rotation.T @ other.rotation, other.scale / first.scale, first.to_scene(offset))


def _check_place(
    first: tuple[LoadedRun, Capture], other: tuple[LoadedRun, Capture], start: MapFrame, geo: MapFrame | None
) -> None:
    """Refuse captures that by GPS lie beside each other."""
    frame = _ITSELF if geo is None else geo
    west, south, east, north = map_extent(frame, first[1])
    w, s, e, n = map_extent(frame.of(start), other[1])
    zones = geo is not None and frame.crs != (_located(*other) or frame).crs
    if zones or w > east or e < west or s > north or n < south:
        apart = np.hypot((west + east - w - e) / 2, (south + north - s - n) / 2)
        raise UserError(
            f"{first[0].directory.path} and {other[0].directory.path} are of different places: by GPS "
            + ("they lie in different UTM zones." if zones else f"their middles lie {apart:,.0f} m apart."),
            "Compare runs of one place.",
        )
