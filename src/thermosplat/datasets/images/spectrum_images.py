"""From the files of a spectrum to training images: pseudo-colour or scalar, palette, unit, range, measured values."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.capture_palette import ChosenPalette, palette_notes
from thermosplat.datasets.images.dead_pixels import far_value, range_without_dead_pixels
from thermosplat.datasets.images.pixel_meaning import (
    PixelMeaning,
    SpectrumFile,
    SpectrumPixels,
    check_finite,
    check_temperatures,
    measured_values,
    three_channels,
)
from thermosplat.errors import UserError
from thermosplat.spectra import CELSIUS, COUNTS, SpectrumConfig, folder_names, label, unit_label
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermal.temperature_units import (
    RadiometricStatement,
    check_filled,
    check_plausible,
    judge_unit,
    may_be_temperature,
    measured_unit,
    to_measured,
    value_ends,
)

_GREY_TOLERANCE = 4
"""Largest difference between channels [8-bit levels] at which a colour file is a grey image (JPEG leaves some)."""


@dataclass(frozen=True, eq=False)
class SpectrumReading:
    """All exposures of a spectrum and what their pixels mean; None where an exposure has no such image.

    ``displays`` are the displayable images as read, uint8 [H, W] or [H, W, 3].
    """

    meaning: PixelMeaning
    pixels: tuple[SpectrumPixels | None, ...]
    notes: tuple[str, ...]
    displays: tuple[NDArray[np.uint8] | None, ...] = ()

    @property
    def scale(self) -> PixelScale:
        """What the pixels mean."""
        return self.meaning.scale


def is_radiometric(image: NDArray[Any]) -> bool:
    """The file holds more than a displayable 8-bit image."""
    return image.ndim == 2 and image.dtype != np.uint8


def interpret(
    name: str,
    files: Sequence[SpectrumFile],
    config: SpectrumConfig,
    *,
    palette: ChosenPalette,
    statement: RadiometricStatement,
    grey_range: tuple[float, float] | None,
    ranging: Sequence[SpectrumFile] | None = None,
) -> SpectrumReading:
    """Decide what the images of a spectrum are and turn them into training images.

    Args:
        files: At least one exposure.
        config: The user's choices; they win over everything the capture states.
        palette: Palette of pseudo-coloured images; a scalar is shown with it.
        grey_range: Temperatures [°C] of black and white in grey images, if the capture states them.
        ranging: Exposures with radiometric values whose extremes are the range, gone through one by one; None:
            `files`.

    Raises:
        UserError: The images are not what the choices ask for, or the values are impossible.
    """
    if config.range is not None and not config.range[0] < config.range[1]:
        low, high = config.range
        raise UserError(f"--{name}.range must be MIN MAX with MIN below MAX, got {low:g} {high:g}.")
    grey_range = grey_range if may_be_temperature(config.unit) else None
    _check_sources(name, files, config, grey_range)
    notes: list[str] = []
    unit = _unit_of(name, files, config, statement, notes)
    displays = [file.display for file in files if file.display is not None]
    if config.source != "raw" and displays:
        if any(display.ndim == 3 and not _is_grey(display) for display in displays):
            return _color_reading(name, files, config, palette, statement, unit, notes)
        return _grey_reading(files, config, palette, grey_range, unit, notes)
    if any(file.raw is not None for file in files):
        return _raw_reading(name, files, ranging, config, palette, unit, notes)
    return _grey_reading(files, config, palette, grey_range, unit, notes)


def _check_sources(
    name: str, files: Sequence[SpectrumFile], config: SpectrumConfig, grey_range: tuple[float, float] | None
) -> None:
    """Refuse a source that the files do not have."""
    for file in files:
        check_finite(file)
    if config.source == "color" and all(file.display is None for file in files):
        kind = files[0].raw.dtype if files[0].raw is not None else "unknown"
        raise UserError(
            f"{files[0].path} holds radiometric values ({kind}), and --{name}.source color asks for 8-bit images.",
            f"Use --{name}.source raw, or leave it at auto.",
        )
    if config.source != "raw" or all(file.raw is not None for file in files):
        return
    lacking = [file for file in files if file.raw is None]
    some = f" ({len(lacking)} of {len(files)} frames have no radiometric file)" if len(lacking) < len(files) else ""
    display = lacking[0].display
    is_grey = display is not None and _is_grey(display)
    if is_grey and not some:
        if grey_range or config.range or not may_be_temperature(config.unit):
            return
        raise UserError(
            f"{lacking[0].path} is 8-bit grey without a temperature range, not temperatures.",
            f"State what black and white stand for: --{name}.range MIN MAX",
        )
    measured = "temperatures" if may_be_temperature(config.unit) else "values"
    found, images, source = ("grey", "grey images", "auto") if is_grey else ("colour (a palette)", "palette", "color")
    raise UserError(
        f"{lacking[0].path} is 8-bit {found}, not {measured}{some}.",
        f"Put 16-bit PNG or float TIFF files with the same stems into {folder_names(name, config)[0]}_raw/, "
        f"or train on the {images} without them: --{name}.source {source}",
    )


def _unit_of(
    name: str,
    files: Sequence[SpectrumFile],
    config: SpectrumConfig,
    statement: RadiometricStatement,
    notes: list[str],
) -> str:
    """The radiometric values' unit: the user's word, the capture's, or judged by the values."""
    raws = [file for file in files if file.raw is not None]
    if not may_be_temperature(config.unit):
        return config.unit
    if not raws:
        return COUNTS
    values = np.concatenate([np.ravel(file.raw[::4, ::4]) for file in raws if file.raw is not None])
    low, high = value_ends(values)
    folder, integer = _folder_name(raws[0].raw_path or raws[0].path), values.dtype.kind in "iu"
    stated = config.unit if config.unit != "auto" else statement.unit
    check_filled(values, stated, folder, f"--{name}.unit counts", integer=integer)
    if stated is not None:
        check_plausible(low, high, stated, folder, name)
        unit = stated
    else:
        unit = judge_unit(low, high, integer=integer)
        meaning = "sensor counts without °C" if unit == COUNTS else unit
        notes.append(f"Values {low:,.6g}-{high:,.6g} in {folder} taken as {meaning}; --{name}.unit says otherwise.")
    for file in raws:
        check_temperatures(file, unit)
    return unit


def _color_reading(
    name: str,
    files: Sequence[SpectrumFile],
    config: SpectrumConfig,
    palette: ChosenPalette,
    statement: RadiometricStatement,
    unit: str,
    notes: list[str],
) -> SpectrumReading:
    """Pseudo-colour as it is; measured values from radiometric files beside it."""
    span = config.range or statement.palette_celsius
    scale = _scale("color", palette, span, unit, config)
    meaning = PixelMeaning("color", scale, unit, config.factor)
    pixels = tuple(map(meaning.pixels, files))
    shown = [three_channels(file.display) for file in files if file.display is not None]
    notes += palette_notes(palette, shown, name)
    if span is None and any(exposure is not None and exposure.values is not None for exposure in pixels):
        what = "temperatures" if scale.unit == CELSIUS else "values"
        notes.append(
            f"The {what} of the palette's ends are unknown, so renders have no {unit_label(scale.unit or unit)}; "
            f"state them with --{name}.range MIN MAX."
        )
    return SpectrumReading(meaning, pixels, tuple(notes))


def _grey_reading(
    files: Sequence[SpectrumFile],
    config: SpectrumConfig,
    palette: ChosenPalette,
    grey_range: tuple[float, float] | None,
    unit: str,
    notes: list[str],
) -> SpectrumReading:
    """8-bit grey: level / 255 is the intensity. Black to white is the stated range, or the factor gives it."""
    span = config.range or grey_range
    if span is None and config.factor != 1 and all(file.raw is None for file in files):
        ends = to_measured(np.array([0, 255]), unit, config.factor)
        span = None if ends is None else (float(ends[0]), float(ends[1]))
    meaning = PixelMeaning("grey", _scale("scalar", palette, span, unit, config), unit, config.factor)
    return SpectrumReading(meaning, tuple(map(meaning.pixels, files)), tuple(notes))


def _raw_reading(
    name: str,
    files: Sequence[SpectrumFile],
    ranging: Sequence[SpectrumFile] | None,
    config: SpectrumConfig,
    palette: ChosenPalette,
    unit: str,
    notes: list[str],
) -> SpectrumReading:
    """Radiometric values, normalised by the user's range or by the extremes of the whole capture.

    Of counts the tails of 0.1% are clipped, so that dead pixels do not set their scale. A range is theirs only if the
    user says that they are counts: what might have been temperatures has a range in °C.
    """
    having = [file for file in files if file.raw is not None] if ranging is None else ranging
    raws = _RawValues(having)
    span = None if unit == COUNTS and config.unit != COUNTS else config.range
    if span is not None:
        low, high = span
    elif unit == COUNTS:
        sample = np.concatenate([np.ravel(raw[::2, ::2]) for raw in raws])
        low, high = (float(end) for end in np.percentile(sample, [0.1, 99.9]))
    else:
        found = range_without_dead_pixels(raws.map(lambda raw: measured_values(raw, unit, config.factor)))
        span = low, high = found.low, found.high
        if found.first is not None:
            where = having[found.first].raw_path or having[found.first].path
            notes.append(
                f"{found.outside:,} lone values lie far beyond all others (first: {where.name}) and are taken for dead "
                f"pixels: the range is {low:,.6g} to {high:,.6g} {unit_label(measured_unit(unit) or unit)}; "
                f"--{name}.range says otherwise."
            )
    if config.range is None:
        notes += _far_notes(files, name)
    scale = _scale("scalar", palette, span, unit, config)
    meaning = PixelMeaning("raw", scale, unit, config.factor, (low, high))
    return SpectrumReading(meaning, tuple(map(meaning.pixels, files)), tuple(notes))


def _far_notes(files: Sequence[SpectrumFile], name: str) -> list[str]:
    """A warning (none or one) of many pixels with one value that lies far from all others, which flattens these."""
    values = np.concatenate([np.ravel(file.raw[::4, ::4]) for file in files if file.raw is not None])
    far = far_value(values)
    if far is None:
        return []
    others = values[values != far]
    return [
        f"About {np.mean(values == far):.1%} of the {label(name)} values are {far:,.6g}, far from all others "
        f"({others.min():,.6g} to {others.max():,.6g}): without a value, or saturated? Mask them "
        f"(docs/data-layouts.md), or state the range: --{name}.range MIN MAX"
    ]


class _RawValues:
    """Radiometric values of exposures, one after the other, as often as they are gone through."""

    def __init__(
        self, files: Sequence[SpectrumFile], changed: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray
    ) -> None:
        self._files, self._changed = files, changed

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return (self._changed(file.raw) for file in self._files if file.raw is not None)

    def map(self, changed: Callable[[NDArray[Any]], NDArray[Any]]) -> "_RawValues":
        """The same, each of them changed."""
        return _RawValues(self._files, changed)


def _scale(
    kind: Literal["color", "scalar"],
    palette: ChosenPalette,
    span: tuple[float, float] | None,
    unit: str,
    config: SpectrumConfig,
) -> PixelScale:
    """What the pixels mean. Images that may be temperatures have °C as their unit, known range or not."""
    return PixelScale(kind, palette.palette, span, CELSIUS if may_be_temperature(config.unit) else measured_unit(unit))


def _is_grey(image: NDArray[np.uint8]) -> bool:
    part = image[::4, ::4].astype(np.int16)
    return image.ndim == 2 or int(np.ptp(part, axis=-1).max()) <= _GREY_TOLERANCE


def _folder_name(path: Path) -> str:
    folder = path.parent
    return f"{(folder.parent if folder.name in ('train', 'test') else folder).name}/"
