"""From thermal files to training images: pseudo-colour or scalar, palette, unit, range, degrees."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config import ThermalConfig
from thermosplat.datasets.capture_palette import ChosenPalette, palette_notes
from thermosplat.datasets.image_files import resize
from thermosplat.datasets.temperature_units import (
    RadiometricStatement,
    Unit,
    check_plausible,
    judge_unit,
    to_celsius,
)
from thermosplat.errors import UserError
from thermosplat.radiometry import ThermalScale

_GREY_TOLERANCE = 4
"""Largest difference between channels [8-bit levels] at which a colour file is a grey image (JPEG leaves some)."""


@dataclass(frozen=True, eq=False)
class ThermalFile:
    """A thermal exposure as read: the displayable image, the radiometric values, or both.

    Args:
        path: File of the displayable image, or of the values where there is no other; for messages.
        display: uint8 [H, W] grey or [H, W, 3] colour.
        raw: [H, W] radiometric values.
        raw_path: Their file.
    """

    path: Path
    display: NDArray[np.uint8] | None
    raw: NDArray[Any] | None = None
    raw_path: Path | None = None


@dataclass(frozen=True, eq=False)
class ThermalPixels:
    """A thermal exposure to train on: `View.image` and `View.celsius`, at the file's size."""

    image: NDArray[np.uint8] | NDArray[np.float32]
    celsius: NDArray[np.float32] | None


@dataclass(frozen=True, eq=False)
class ThermalReading:
    """All thermal exposures of a capture and what their values mean; None where an exposure has no such image."""

    scale: ThermalScale
    pixels: tuple[ThermalPixels | None, ...]
    notes: tuple[str, ...]


def is_radiometric(image: NDArray[Any]) -> bool:
    """The file holds more than a displayable 8-bit image."""
    return image.ndim == 2 and image.dtype != np.uint8


def interpret(
    files: Sequence[ThermalFile],
    config: ThermalConfig,
    *,
    palette: ChosenPalette,
    statement: RadiometricStatement,
    grey_range: tuple[float, float] | None,
) -> ThermalReading:
    """Decide what the thermal images are and turn them into training images.

    Args:
        files: At least one exposure.
        config: The user's choices; they win over everything the capture states.
        palette: Palette of pseudo-coloured images; a scalar is shown with it.
        statement: What the capture says of its radiometric values.
        grey_range: Temperatures [°C] of black and white in grey images, if the capture states them.

    Raises:
        UserError: The images are not what the choices ask for, or the values are impossible.
    """
    if config.range_celsius is not None and not config.range_celsius[0] < config.range_celsius[1]:
        low, high = config.range_celsius
        raise UserError(f"--thermal.range-celsius must be MIN MAX with MIN below MAX, got {low:g} {high:g}.")
    _check_sources(files, config, grey_range)
    notes: list[str] = []
    unit = _unit_of(files, config, statement, notes)
    displays = [file.display for file in files if file.display is not None]
    if config.source != "raw" and displays:
        if any(display.ndim == 3 and not _is_grey(display) for display in displays):
            return _color_reading(files, config, palette, statement, unit, notes)
        return _grey_reading(files, config, palette, grey_range, unit, notes)
    if any(file.raw is not None for file in files):
        return _raw_reading(files, config, palette, unit, notes)
    return _grey_reading(files, config, palette, grey_range, unit, notes)


def _check_sources(files: Sequence[ThermalFile], config: ThermalConfig, grey_range: tuple[float, float] | None) -> None:
    """Refuse a source that the files do not have."""
    for file in files:
        if file.raw is not None and not np.isfinite(file.raw).all():
            count = int((~np.isfinite(file.raw)).sum())
            raise UserError(
                f"{file.raw_path or file.path} has {count:,} pixels that are not finite numbers.",
                "Fill or re-export them.",
            )
    if config.source == "color" and all(file.display is None for file in files):
        kind = files[0].raw.dtype if files[0].raw is not None else "unknown"
        raise UserError(
            f"{files[0].path} holds radiometric values ({kind}), and --thermal.source color asks for 8-bit images.",
            "Use --thermal.source raw, or leave it at auto.",
        )
    if config.source != "raw" or all(file.raw is not None for file in files):
        return
    lacking = [file for file in files if file.raw is None]
    display = lacking[0].display
    if display is not None and (display.ndim == 2 or _is_grey(display)):
        if grey_range or config.range_celsius:
            return
        raise UserError(
            f"{lacking[0].path} is 8-bit grey without a temperature range, not temperatures.",
            "State what black and white stand for: --thermal.range-celsius MIN MAX",
        )
    others = f" ({len(lacking)} of {len(files)} frames have no radiometric file)" if len(lacking) < len(files) else ""
    raise UserError(
        f"{lacking[0].path} is 8-bit colour (a palette), not temperatures{others}.",
        "Put 16-bit PNG or float TIFF files with the same stems into thermal_raw/, "
        "or train on the palette without them: --thermal.source color",
    )


def _unit_of(
    files: Sequence[ThermalFile], config: ThermalConfig, statement: RadiometricStatement, notes: list[str]
) -> Unit:
    """The radiometric values' unit: the user's word, the capture's, or judged by the values."""
    raws = [file for file in files if file.raw is not None]
    if not raws:
        return "counts"
    values = np.concatenate([np.ravel(file.raw[::4, ::4]) for file in raws if file.raw is not None])
    low, high = (float(end) for end in np.percentile(values, [1, 99]))
    folder = _folder_name(raws[0].raw_path or raws[0].path)
    if config.unit != "auto":
        check_plausible(low, high, config.unit, folder)
        return config.unit
    if statement.unit is not None:
        check_plausible(low, high, statement.unit, folder)
        return statement.unit
    unit = judge_unit(low, high, integer=values.dtype.kind in "iu")
    meaning = "sensor counts without °C" if unit == "counts" else unit
    notes.append(f"Values {low:,.6g}-{high:,.6g} in {folder} taken as {meaning}; --thermal.unit says otherwise.")
    return unit


def _color_reading(
    files: Sequence[ThermalFile],
    config: ThermalConfig,
    palette: ChosenPalette,
    statement: RadiometricStatement,
    unit: Unit,
    notes: list[str],
) -> ThermalReading:
    """Pseudo-colour as it is; degrees from radiometric files beside it."""
    pixels = [
        None if file.display is None else ThermalPixels(_three_channels(file.display), _celsius_beside(file, unit))
        for file in files
    ]
    shown = [_three_channels(file.display) for file in files if file.display is not None]
    notes += palette_notes(palette, shown)
    span = config.range_celsius or statement.palette_celsius
    if span is None and any(exposure is not None and exposure.celsius is not None for exposure in pixels):
        notes.append(
            "The temperatures of the palette's ends are unknown, so renders have no °C; "
            "state them with --thermal.range-celsius MIN MAX."
        )
    return ThermalReading(ThermalScale("color", palette.palette, span), tuple(pixels), tuple(notes))


def _grey_reading(
    files: Sequence[ThermalFile],
    config: ThermalConfig,
    palette: ChosenPalette,
    grey_range: tuple[float, float] | None,
    unit: Unit,
    notes: list[str],
) -> ThermalReading:
    """8-bit grey: level / 255 is the intensity, black to white the stated range."""
    span = config.range_celsius or grey_range
    scale = ThermalScale("scalar", palette.palette, span)
    pixels: list[ThermalPixels | None] = []
    for file in files:
        if file.display is None:
            pixels.append(None)
            continue
        grey = file.display if file.display.ndim == 2 else file.display[..., 1]
        image = np.asarray(grey[..., None] / np.float32(255), np.float32)
        celsius = _celsius_beside(file, unit)
        if celsius is None and span is not None:
            celsius = scale.celsius(image[..., 0])
        pixels.append(ThermalPixels(image, celsius))
    return ThermalReading(scale, tuple(pixels), tuple(notes))


def _raw_reading(
    files: Sequence[ThermalFile], config: ThermalConfig, palette: ChosenPalette, unit: Unit, notes: list[str]
) -> ThermalReading:
    """Radiometric values, normalised by the user's range or by the extremes of the whole capture.

    Counts have no range to state; the tails of 0.1% are clipped, so that dead pixels do not set their scale.
    """
    raws = [file.raw for file in files if file.raw is not None]
    if unit == "counts":
        sample = np.concatenate([np.ravel(raw[::2, ::2]) for raw in raws])
        low, high = (float(end) for end in np.percentile(sample, [0.1, 99.9]))
        span = None
    else:
        span = config.range_celsius
        if span is None:
            extremes = np.array([extreme for raw in raws for extreme in (raw.min(), raw.max())])
            ends = to_celsius(extremes, unit)
            span = (float(np.min(ends)), float(np.max(ends)))  # type: ignore[arg-type]
        low, high = span
    width = max(high - low, 1e-6)
    pixels: list[ThermalPixels | None] = []
    for file in files:
        if file.raw is None:
            pixels.append(None)
            continue
        celsius = to_celsius(file.raw, unit)
        values = file.raw.astype(np.float32) if celsius is None else celsius
        image = np.asarray(np.clip((values - low) / width, 0, 1)[..., None], np.float32)
        pixels.append(ThermalPixels(image, celsius))
    return ThermalReading(ThermalScale("scalar", palette.palette, span), tuple(pixels), tuple(notes))


def _celsius_beside(file: ThermalFile, unit: Unit) -> NDArray[np.float32] | None:
    """Degrees from the radiometric file of an exposure, at the size of its displayable image."""
    if file.raw is None or file.display is None:
        return None
    celsius = to_celsius(file.raw, unit)
    return None if celsius is None else resize(celsius, file.display.shape[1], file.display.shape[0])


def _is_grey(image: NDArray[np.uint8]) -> bool:
    part = image[::4, ::4].astype(np.int16)
    return image.ndim == 2 or int(np.ptp(part, axis=-1).max()) <= _GREY_TOLERANCE


def _three_channels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)


def _folder_name(path: Path) -> str:
    folder = path.parent
    return f"{(folder.parent if folder.name in ('train', 'test') else folder).name}/"
