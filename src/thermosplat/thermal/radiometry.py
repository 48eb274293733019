"""What pixel values mean: palettes of pseudo-coloured images, units and ranges of radiometric ones.

A palette maps a scalar *intensity* in [0, 1], monotone in temperature, to a colour. Its inverse finds the nearest point
of the palette's curve in RGB space, so that noise and JPEG artefacts next to the curve do no harm.
"""

import csv
import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular
from thermosplat.spectra import ColorSpace
from thermosplat.thermal.level_table import LevelTable
from thermosplat.thermal.palette_inverse import TABLE_SIZE, Curve, nearest_points

_TABLE_SAMPLES = 512
"""Points of the curve that compete for a cell of the table."""
_MOST_ENTRIES = 4096
"""Of a palette that is read: cameras have 120 to 256. The inverse takes time in proportion."""
_LARGEST_PALETTE_FILE = 1 << 24
_CHUNK = 1 << 13
"""Pixels treated at once, so that the intermediate arrays stay in the cache."""


@dataclass(frozen=True, eq=False)
class Palette:
    """A colour curve, linear between equally spaced entries.

    Args:
        colors: [n, 3] float32 in [0, 1], n ≥ 2; entry 0 is the coldest.
    """

    colors: NDArray[np.float32]

    def __post_init__(self) -> None:
        colors = np.array(self.colors, np.float32)
        if colors.ndim != 2 or colors.shape[1] != 3 or len(colors) < 2 or not np.isfinite(colors).all():
            raise UserError(f"A palette needs at least two finite RGB entries, got an array of shape {colors.shape}.")
        if colors.min() < 0 or colors.max() > 1:
            raise UserError(f"Palette colours must lie in [0, 1], got {colors.min():g} to {colors.max():g}.")
        colors.setflags(write=False)
        object.__setattr__(self, "colors", colors)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Palette) and np.array_equal(self.colors, other.colors)

    def __hash__(self) -> int:
        return hash(self.colors.tobytes())

    def to_color(self, intensity: ArrayLike) -> NDArray[np.float32]:
        """Colour of an intensity.

        Args:
            intensity: [...] in [0, 1]; values outside are clipped.

        Returns:
            [..., 3] float32 in [0, 1].
        """
        position = np.clip(np.asarray(intensity, np.float32), 0, 1) * np.float32(len(self.colors) - 1)
        segment = np.minimum(position.astype(np.intp), len(self.colors) - 2)
        fraction = (position - segment)[..., None]
        return self.colors[segment] * (1 - fraction) + self.colors[segment + 1] * fraction

    def to_intensity(self, color: ArrayLike) -> NDArray[np.float32]:
        """Intensity of the curve's point nearest to a colour.

        Args:
            color: [..., 3] in [0, 1], or uint8 levels (faster: of many of them each is computed once).

        Returns:
            [...] float32 in [0, 1].
        """
        color = np.asarray(color)
        if color.dtype != np.uint8:
            return self._project(color)[0]
        return self._of_levels(color) if color.size < 3 * _CHUNK else self._table_of_levels(color)

    def residual(self, color: ArrayLike) -> float:
        """Mean distance of colours to the curve [8-bit levels]: about 2 for JPEGs of the right palette.

        Args:
            color: [..., 3] in [0, 1].
        """
        return float(np.mean(self._project(color)[1])) * 255

    def _project(self, color: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Intensity of, and distance to, the nearest point of the curve; both [...]."""
        color = np.asarray(color, np.float32)
        flat = color.reshape(-1, 3)
        intensity = np.empty(len(flat), np.float32)
        distance = np.empty(len(flat), np.float32)
        for start in range(0, len(flat), _CHUNK):
            part = slice(start, start + _CHUNK)
            channels = np.ascontiguousarray(flat[part].T)
            intensity[part], distance[part] = nearest_points(channels, self.curve, np)
        return intensity.reshape(color.shape[:-1]), distance.reshape(color.shape[:-1])

    def _of_levels(self, levels: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._project(levels / np.float32(255))[0]

    @cached_property
    def _table_of_levels(self) -> LevelTable:
        return LevelTable(self._of_levels)

    @cached_property
    def curve(self) -> Curve:
        """The palette as its inverse reads it; made once, the first time the inverse is asked."""
        starts = np.ascontiguousarray(self.colors[:-1].T)
        directions = np.ascontiguousarray(np.diff(self.colors, axis=0).T)
        squared_lengths = np.maximum((directions * directions).sum(axis=0), np.float32(1e-12))
        return Curve(starts, directions, squared_lengths, self._table())

    def _table(self) -> NDArray[np.int64]:
        """Nearest segment of each cell's centre, [TABLE_SIZE³]."""
        axis = (np.arange(TABLE_SIZE, dtype=np.float32) + 0.5) / TABLE_SIZE
        centres = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        intensity = np.linspace(0, 1, _TABLE_SAMPLES, dtype=np.float32)
        samples = self.to_color(intensity)
        half_squares = (samples * samples).sum(-1) / 2
        parts = [
            np.argmin(half_squares - centres[start : start + 4096] @ samples.T, axis=1)
            for start in range(0, len(centres), 4096)
        ]
        return (intensity[np.concatenate(parts)] * (len(self.colors) - 1)).astype(np.int64)


def _flir_iron() -> Palette:
    """FLIR's "Iron", read out of FLIR E6xt files (Y, Cr, Cb, limited-range BT.601), at nine of its 256 entries."""
    stops = [0, 32, 64, 96, 128, 160, 192, 224, 255]
    colors = np.array(
        [
            (0, 0, 0),
            (62, 0, 142),
            (144, 2, 164),
            (202, 35, 126),
            (237, 83, 62),
            (254, 139, 7),
            (254, 192, 0),
            (253, 236, 73),
            (254, 254, 254),
        ]
    )
    entries = np.stack([np.interp(np.arange(256), stops, channel) for channel in colors.T], -1)
    return Palette((entries / 255).astype(np.float32))


FLIR_IRON = _flir_iron()
"""The palette of RGBT-Scenes and of most FLIR cameras ("ironbow"), linear between nine stops."""


def load_palette(path: str | Path, spectrum: str) -> Palette:
    """Read a palette.

    Args:
        path: JSON ``{"lut": [[r, g, b], ...]}`` or CSV rows ``r,g,b``, levels 0 to 255, coldest first. A CSV may begin
            with one line of column names.
        spectrum: Name of the spectrum that it is for, for messages.

    Raises:
        UserError: The file cannot be read or holds something else.
    """
    path = Path(path)
    hint = f'Give a JSON file {{"lut": [[r, g, b], ...]}} or a CSV with r,g,b rows (0-255) to --{spectrum}.palette.'
    try:
        if path.stat().st_size > _LARGEST_PALETTE_FILE:
            raise ValueError("too large for a palette")
        text = read_regular(path).decode("utf-8-sig")  # spreadsheets begin a CSV with a byte-order mark
        rows = json.loads(text)["lut"] if path.suffix.lower() == ".json" else _csv_rows(text)
        levels = np.array(rows, np.float64)
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"Cannot read the palette {path}: {error.strerror or error}.", hint) from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError, csv.Error) as error:
        raise UserError(f"{path} is not a palette.", hint) from error
    if len(levels.shape) == 2 and len(levels) > _MOST_ENTRIES:
        raise UserError(f"{path} has {len(levels):,} rows; a palette has {_MOST_ENTRIES:,} entries at most.", hint)
    if levels.ndim != 2 or levels.shape[1:] != (3,) or len(levels) < 2:
        raise UserError(f"{path} is not a palette: expected rows of three levels, got shape {levels.shape}.", hint)
    if not (levels.min() >= 0 and levels.max() <= 255):
        raise UserError(f"{path}: levels must lie in 0 to 255, got {levels.min():g} to {levels.max():g}.", hint)
    return Palette((levels / 255).astype(np.float32))


def _csv_rows(text: str) -> list[list[float]]:
    rows = [row for row in csv.reader(text.splitlines()) if row and not row[0].lstrip().startswith("#")]
    return [[float(level) for level in row] for row in (rows[1:] if rows and _names_columns(rows[0]) else rows)]


def _names_columns(row: list[str]) -> bool:
    try:
        float(row[0])
    except ValueError:
        return True
    return False


GREY = Palette(np.array([(0, 0, 0), (1, 1, 1)], np.float32))
"""Black to white."""


@dataclass(frozen=True)
class PixelScale:
    """What the pixel values of a capture's images of one spectrum mean.

    Args:
        kind: "photograph" for colours, "color" for pseudo-colours, "scalar" for one value per pixel, "labels" for
            colours of classes, "stack" for channels in a basis.
        palette: The data's palette ("color"), or the one to show a scalar with.
        range: Values [unit] that intensity 0 and 1 stand for; None where the data has no unit.
        unit: The values' unit, "celsius" for temperatures; None where the data has none.
        basis: float32 [n, channels], orthonormal rows, of a stack that was read; its scene keeps it.
    """

    kind: ColorSpace
    palette: Palette = GREY
    range: tuple[float, float] | None = None
    unit: str | None = None
    basis: NDArray[np.float32] | None = field(default=None, compare=False)

    @property
    def channels(self) -> int:
        """Channels of an image as it is shown: 1 for values, else 3, of a stack the first ones."""
        return 1 if self.kind == "scalar" else 3

    @property
    def has_intensity(self) -> bool:
        """Whether a pixel stands for one number: of values, and of pseudo-colours."""
        return self.kind in ("color", "scalar")

    @property
    def is_taken(self) -> bool:
        """Whether a camera took the images: labels and stacks are made of others, and may look like anything."""
        return self.kind not in ("labels", "stack")

    @property
    def measured_unit(self) -> str | None:
        """The unit in which images can be measured; None where they cannot."""
        return None if self.range is None else self.unit

    def value(self, intensity: Any) -> Any:
        """Measured value [unit] of an intensity (an array or tensor of any shape, or a number).

        Raises:
            ValueError: The images have no unit (``range`` is None).
        """
        if self.range is None:
            raise ValueError("These images have no range of values, so nothing can be measured in them.")
        low, high = self.range
        return low + intensity * (high - low)

    def state_dict(self) -> dict[str, Any]:
        """Plain Python values that `from_state_dict` understands."""
        return {
            "kind": self.kind,
            "palette": self.palette.colors.tolist(),
            "range": None if self.range is None else [float(end) for end in self.range],
            "unit": self.unit,
        }

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> "PixelScale":
        """The scale that `state_dict` described."""
        span, palette = state["range"], Palette(np.array(state["palette"], np.float32))
        return cls(state["kind"], palette, None if span is None else (float(span[0]), float(span[1])), state["unit"])
