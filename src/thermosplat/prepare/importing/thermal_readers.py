"""Temperatures of thermal files of each kind, what the files say of them, and what has to be said about that.

Each kind has a reader: ``celsius`` gives the temperatures of a file, or None for counts that nobody explained,
``parameters`` what it says of object, air and camera, ``sentences`` what was found in all files that were read.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_bytes import read_regular_file
from thermosplat.datasets.images.image_files import read_image, read_pixels
from thermosplat.errors import UserError
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.camera_groups import PALETTE_LIMIT
from thermosplat.prepare.importing.dji_files import DjiFile, read_dji
from thermosplat.prepare.importing.dji_programs import INSTALL, PROGRAMS, Conversion, converted, installed
from thermosplat.prepare.importing.embedded_picture import shows_the_same
from thermosplat.prepare.importing.flight_data import xmp_fields, xmp_packet
from thermosplat.prepare.importing.flir_files import FlirImage, read_flir, read_flir_camera
from thermosplat.prepare.importing.source_files import SourceFile
from thermosplat.prepare.importing.thermal_values import Meaning, unit_sentence, without_value
from thermosplat.prepare.progress import tracked
from thermosplat.thermal.radiometry import FLIR_IRON, GREY
from thermosplat.thermal.thermal_parameters import ThermalParameters

_SATURATED = 0.01
"""Share of pixels above what a camera can measure that have no temperature, as dead ones; more are a hot scene."""
_MIDDLE, _ROUNDED = 4, 1.5
"""How many pixels from the middle an XT may have measured, and how far [°C] its whole degrees may lie beside them."""


class Reader(Protocol):
    """What reads thermal files of one kind."""

    def celsius(self, file: SourceFile) -> NDArray[Any] | None:
        """Temperatures [°C], [H, W]; NaN where there is none. None: counts."""

    def parameters(self, file: SourceFile) -> ThermalParameters | None:
        """What the file says of object, air and camera."""

    def sentences(self) -> list[str]:
        """What was found."""


@contextmanager
def reader_for(files: Sequence[SourceFile], wanted: Sequence[SourceFile], meaning: Meaning) -> Iterator[Reader]:
    """The reader of a capture's thermal files.

    Args:
        wanted: Those of which temperatures will be asked.
        meaning: What values mean in files that do not say it.

    Raises:
        UserError: Files hold counts, and no program that converts them is installed.
    """
    if files[0].kind == "flir":
        yield FlirReader()
    elif files[0].kind == "dji":
        with _dji_reader(files, wanted) as reader:
            yield reader
    else:
        yield ValueReader(files[0], meaning)


class ValueReader:
    """Files of plain values."""

    def __init__(self, first: SourceFile, meaning: Meaning) -> None:
        self._first, self._meaning = first, meaning

    def celsius(self, file: SourceFile) -> NDArray[Any] | None:
        """Temperatures [°C]; None for counts."""
        pixels = read_pixels(file.path)
        celsius = self._meaning.celsius(pixels.image)
        return None if celsius is None else np.where(without_value(pixels), np.nan, celsius)

    def parameters(self, file: SourceFile) -> None:
        """They say nothing."""

    def sentences(self) -> list[str]:
        """What the values were taken for."""
        return [unit_sentence(self._meaning, self._first)]


class FlirReader:
    """FLIR's radiometric JPEGs, and those of DJI's XT cameras, which are FLIR's inside."""

    def __init__(self) -> None:
        self._seen: list[ThermalParameters] = []
        self._beyond: list[tuple[str, int, float, FlirImage]] = []

    def celsius(self, file: SourceFile) -> NDArray[Any]:
        """Temperatures [°C]; NaN where few counts are saturated.

        Raises:
            UserError: They are not what the camera can measure, or contradict what an XT camera states.
        """
        image = read_flir(file.path)
        celsius = image.celsius
        lowest, highest = image.span
        with np.errstate(invalid="ignore"):
            above, below = celsius > highest, celsius < lowest
        outside = int(above.sum() + below.sum())
        if 2 * outside > celsius.size:
            raise _wrong(
                file.path,
                f"{outside / celsius.size:.0%} lie outside the {lowest:.0f} to {highest:.0f} °C of the camera",
            )
        _check_xt(file, celsius)
        if outside:
            extreme = float(np.nanmax(celsius) if above.any() else np.nanmin(celsius))
            self._beyond.append((file.name, outside, extreme, image))
        return np.where(above, np.nan, celsius) if above.sum() <= _SATURATED * celsius.size else celsius

    def parameters(self, file: SourceFile) -> ThermalParameters:
        """The calibration, which temperatures are computed with."""
        self._seen.append(ThermalParameters.of_camera(read_flir_camera(file.path)))
        return self._seen[-1]

    def sentences(self) -> list[str]:
        """With which assumptions, and how many pixels the cameras cannot measure."""
        said = [
            f"Temperatures were computed from the counts of FLIR files, for {stated(self._seen)}, as each file says."
        ]
        if self._beyond:
            name, _, extreme, image = self._beyond[0]
            pixels = sum(count for _, count, _, _ in self._beyond)
            where = counted(len(self._beyond), "file")
            said.append(
                f"{counted(pixels, 'pixel')} of {where} {agreeing(pixels, 'lies', 'lie')} outside the "
                f"{image.span[0]:.0f} to {image.span[1]:.0f} °C that the camera can measure (first: {name}, "
                f"{extreme:.0f} °C): clear sky, or a saturated sensor. Do not read them."
            )
        return said


class DjiReader:
    """DJI's radiometric JPEGs.

    Args:
        conversion: What programs made of all files; None if the files hold temperatures.
    """

    def __init__(self, models: Sequence[str], conversion: Conversion | None) -> None:
        self._models, self._conversion = list(dict.fromkeys(models)), conversion
        self._seen: list[ThermalParameters] = []

    def celsius(self, file: SourceFile) -> NDArray[np.float32]:
        """Temperatures [°C], held against all else that the file says."""
        held = read_dji(file.path)
        return held.celsius() if self._conversion is None else self._conversion.celsius(held)

    def parameters(self, file: SourceFile) -> ThermalParameters:
        """What the file states, which programs apply."""
        found = read_dji(file.path).parameters
        applied = ThermalParameters(**{**vars(found), "applied": self._conversion is not None})
        self._seen.append(applied)
        return applied

    def sentences(self) -> list[str]:
        """Where temperatures come from, and what is in them."""
        which = " and ".join(self._models)
        values = stated(self._seen)
        if self._conversion is not None:
            programs = " and ".join(dict.fromkeys(self._conversion.programs.values())) or "an installed program"
            how = f"for {values}, as each file says" if values else "with its own assumptions, as the files state none"
            return [f"Counts of {which} files were converted by {programs}, {how}."]
        return [
            f"Temperatures were read from {which} files as they are stored: those of a black body before the lens. "
            f"DJI's programs correct them for {values or 'what the file states'}; nothing is corrected here."
        ]


@contextmanager
def _dji_reader(files: Sequence[SourceFile], wanted: Sequence[SourceFile]) -> Iterator[DjiReader]:
    """The reader of R-JPEGs: one way for all of them, as DJI's programs correct what the files leave uncorrected."""
    models: list[str] = []
    readable: set[Path] = set()
    with_counts, first = 0, None
    for file in tracked(files, "looking at DJI files", len(files)):
        held = _readable(file)
        if held is not None:
            models.append(held.model)
            readable.add(file.path)
            if not held.holds_temperatures:
                with_counts, first = with_counts + 1, first or held
    if first is None:
        yield DjiReader(models, None)
        return
    if not installed():
        count = f"{with_counts} of {counted(len(readable), f'{first.model} file')}"
        raise UserError(
            f"{count} {agreeing(with_counts, 'holds', 'hold')} sensor counts and no temperatures (first: "
            f"{first.path}). DJI's own program or dji-thermal-cli converts them, and neither {' nor '.join(PROGRAMS)} "
            "is on the PATH.",
            f"{INSTALL} Or export 16-bit TIFFs and give their folder: --thermal DIR. {_pictures_offer(first)}",
        )
    with converted([file.path for file in wanted if file.path in readable]) as conversion:
        yield DjiReader(models, conversion)


def _readable(file: SourceFile) -> DjiFile | None:
    """What a file holds; None where it is damaged, which is said when it is asked for its temperatures."""
    try:
        return read_dji(file.path)
    except UserError:
        return None


def holds_counts(file: SourceFile) -> bool:
    """Whether an R-JPEG holds counts that only a program converts."""
    held = _readable(file) if file.kind == "dji" else None
    return held is not None and not held.holds_temperatures


def _pictures_offer(file: DjiFile) -> str:
    """How well the pictures' palette can be inverted instead."""
    picture = file.picture()
    if picture is None:
        return ""
    colors = picture[::4, ::4] / np.float32(255)
    name, residual = min(
        ((n, p.residual(colors)) for n, p in (("grey", GREY), ("iron", FLIR_IRON))), key=lambda o: o[1]
    )
    if residual > PALETTE_LIMIT:
        return f"Their pictures can be taken as levels if you have their palette, which is not {name}: --palette FILE."
    return (
        f"Or take their pictures as levels without degrees: --palette {name}, from which they lie {residual:.1f} of "
        "255 levels."
    )


def stated(parameters: Sequence[ThermalParameters]) -> str:
    """What files state of object and distance, in words: one value, or from which to which; empty for nothing."""
    parts = []
    for name, form, what in (
        ("emissivity", "{:.2f}", "an emissivity of {}"),
        ("reflected_celsius", "{:.0f}", "{} °C reflected"),
        ("distance_metres", "{:.1f}", "{} m"),
    ):
        values = [value for one in parameters if (value := getattr(one, name)) is not None]
        if values:
            ends = list(dict.fromkeys(form.format(end) for end in (min(values), max(values))))
            parts.append(what.format(" to ".join(ends)))
    return "".join(parts) if len(parts) < 2 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _check_xt(file: SourceFile, celsius: NDArray[Any]) -> None:
    """Hold the temperatures of DJI's XT cameras against their picture, and the middle's temperature in their XMP."""
    if not (file.exif.make or "").upper().startswith("DJI"):
        return
    fields = xmp_fields(xmp_packet(read_regular_file(file.path)))
    height, width = celsius.shape
    middle = celsius[height // 2 - _MIDDLE : height // 2 + _MIDDLE, width // 2 - _MIDDLE : width // 2 + _MIDDLE]
    low, high = float(np.nanmin(middle)), float(np.nanmax(middle))
    try:
        named = float(fields["CentralTemperature"])
    except (KeyError, ValueError):
        named = low
    if not low - _ROUNDED <= named <= high + _ROUNDED:
        raise _wrong(file.path, f"the middle has {low:.1f} to {high:.1f} °C, and the file states {named:.0f} °C")
    if not shows_the_same(celsius, read_image(file.path), file.exif.digital_zoom or 1.0):
        raise _wrong(file.path, "the picture in it shows something else")


def _wrong(path: Path, why: str) -> UserError:
    return UserError(
        f"The temperatures in {path} cannot be right: {why}.",
        "Copy the file from the camera again, or leave it out: --skip-unreadable",
    )
