"""The thermal images of a capture: 16-bit values with a unit, or 8-bit pictures where there are no values."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.capture_palette import choose_palette
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import OTHER, CaptureFolder, FrameRow
from thermosplat.prepare.counted import agreeing, counted
from thermosplat.prepare.importing.dji_programs import installed
from thermosplat.prepare.importing.source_files import SourceFile
from thermosplat.prepare.importing.thermal_readers import Reader, holds_counts, reader_for
from thermosplat.prepare.importing.thermal_values import (
    STEPS_PER_KELVIN,
    StoredUnit,
    TooHot,
    choose_meaning,
    counts_of,
    levels_of,
)
from thermosplat.prepare.progress import tracked
from thermosplat.prepare.whole_files import write_png
from thermosplat.regular_files import read_regular
from thermosplat.runs.atomic_writes import write_bytes
from thermosplat.spectra import COUNTS, TEMPERATURE_UNITS, THERMAL, unit_named
from thermosplat.thermal.planck_counts import ZERO_CELSIUS
from thermosplat.thermal.radiometry import GREY, Palette
from thermosplat.thermal.thermal_parameters import ThermalParameters, parameters_text

Turn = Literal[0, 90, 180, 270]
_RESIDUAL_LIMIT, _RESIDUAL_LIMIT_ASSUMED = 15.0, 25.0
"""As in capture_palette.py, where they were measured: beyond it an image does not have the palette."""
_GREY_LIMIT = 6.0
"""Mean distance from grey [8-bit levels] up to which a picture is white-hot: the channels of such JPEGs differ by up to
8 levels. The colours of a mostly cold picture in FLIR Iron lie nearer to that palette."""
_SAMPLED = 6


@dataclass(frozen=True)
class ThermalOptions:
    """What the user says about thermal files.

    Args:
        unit: Unit of the values after scale and offset.
        scale: What stored values are multiplied by.
        offset: What is added then.
        range: °C of the palette's ends, for pseudo-colour and grey pictures.
        palette: A file with the palette, or "iron" or "grey".
        keep_color: Leave pseudo-colour as it is.
        turn: Degrees by which thermal images are turned clockwise.
        mirror: Thermal images are mirrored, left and right.
    """

    unit: str | None = None
    scale: float | None = None
    offset: float | None = None
    range: tuple[float, float] | None = None
    palette: str | None = None
    keep_color: bool = False
    turn: Turn = 0
    mirror: bool = False

    def __post_init__(self) -> None:
        if self.unit is not None:
            object.__setattr__(self, "unit", unit_named(self.unit))
        if self.unit is not None and self.unit not in (*TEMPERATURE_UNITS, COUNTS):
            known = ", ".join((*TEMPERATURE_UNITS, COUNTS))
            raise UserError(f"--unit {self.unit} is not known.", f"Known are {known}.")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise UserError(f"--range must be MIN MAX with MIN below MAX, got {self.range[0]:g} {self.range[1]:g}.")

    def settings(self) -> dict[str, Any]:
        """As plain values."""
        return asdict(self)

    def upright(self, image: NDArray[Any]) -> NDArray[Any]:
        """The image [H, W, ...] turned and mirrored as the user says."""
        turned = np.rot90(image, -self.turn // 90)
        return np.ascontiguousarray(turned[:, ::-1] if self.mirror else turned)


def import_thermal(
    files: Sequence[SourceFile],
    names: Sequence[str],
    capture: CaptureFolder,
    options: ThermalOptions,
    *,
    skip_unreadable: bool = False,
) -> tuple[list[FrameRow], list[str]]:
    """Write the thermal images of a capture, ``units.json`` and ``thermal_parameters.json``.

    Args:
        files: The files, all of one kind; radiometric, or pictures.
        names: Their names in the capture, without endings.
        skip_unreadable: Leave out radiometric files of which no temperatures can be had.

    Returns:
        Their rows of frames.csv, and what was found.

    Raises:
        UserError: A file cannot be read, or the options do not fit.
    """
    if not files[0].is_radiometric or _pictures_are_asked_for(files, options):
        return _import_pictures(files, names, capture, options)
    meaning = choose_meaning(files, options.unit, options.scale, options.offset)
    units: tuple[StoredUnit, ...] = ("counts",) if meaning.unit == COUNTS else ("centikelvin", "decikelvin")
    targets = [_target(capture, name) for name in names]
    complete = _stated_unit(capture) in units and all(target.exists() for target in targets)
    with reader_for(files, [] if complete else files, meaning) as reader:
        for unit in units:
            try:
                return _import_values(files, targets, capture, options, reader, unit, skip_unreadable)
            except TooHot:
                for target in targets:
                    target.unlink(missing_ok=True)
    raise AssertionError("the last unit raises no TooHot")


def _pictures_are_asked_for(files: Sequence[SourceFile], options: ThermalOptions) -> bool:
    """The user says how to read the pictures of files with counts that no installed program converts."""
    asked = options.palette is not None or options.range is not None or options.keep_color
    return asked and not installed() and any(holds_counts(file) for file in files)


def _import_values(
    files: Sequence[SourceFile],
    targets: Sequence[Path],
    capture: CaptureFolder,
    options: ThermalOptions,
    reader: Reader,
    unit: StoredUnit,
    skip_unreadable: bool,
) -> tuple[list[FrameRow], list[str]]:
    rows: list[FrameRow] = []
    failed: list[UserError] = []
    parameters: dict[str, ThermalParameters] = {}
    dead, lowest, highest = 0, np.inf, -np.inf
    for file, target in tracked(zip(files, targets), "importing thermal images", len(files)):
        try:
            if not (target.exists() and _stated_unit(capture) == unit):
                celsius = reader.celsius(file)
                read, filled = counts_of(file.path) if celsius is None else levels_of(file.path, celsius, unit)
                dead += filled
                if _stated_unit(capture) != unit:
                    _state(capture, unit)
                write_png(target, options.upright(file.turned(read)))
            if (said := reader.parameters(file)) is not None:
                parameters[target.name] = said
        except UserError as error:
            if not skip_unreadable:
                raise
            failed.append(error)
            continue
        values = read_image(target)
        lowest, highest = min(lowest, float(values.min())), max(highest, float(values.max()))
        rows.append(_row(target.name, file, values))
    if not rows:
        raise failed[0]
    if parameters:
        write_bytes(capture.thermal_parameters, parameters_text(parameters).encode())
    sentences = reader.sentences()
    if unit == COUNTS:
        sentences.append(f"They lie between {lowest:,.0f} and {highest:,.0f}.")
    else:
        low, high = (end / STEPS_PER_KELVIN[unit] - ZERO_CELSIUS for end in (lowest, highest))
        sentences.append(f"They lie between {low:.1f} and {high:.1f} °C; images/thermal/units.json says {unit}.")
    if dead:
        sentences.append(
            f"{counted(dead, 'pixel')} without a temperature {agreeing(dead, 'was', 'were')} filled from the "
            "neighbours."
        )
    if failed:
        count = counted(len(failed), "thermal file was", "thermal files were")
        sentences.append(f"{count} left out (first: {failed[0].message.rstrip('.')}).")
    return rows, sentences


def _import_pictures(
    files: Sequence[SourceFile], names: Sequence[str], capture: CaptureFolder, options: ThermalOptions
) -> tuple[list[FrameRow], list[str]]:
    """Grey and pseudo-coloured pictures: through the inverse palette where they have it, else as they are."""
    config = replace(THERMAL, palette=options.palette)
    chosen = choose_palette(capture.root, OTHER, config, [file.path for file in files if file.frame is None])
    images = [file.read() for file in files[:: -(-len(files) // _SAMPLED)]]
    colored = [image for image in images if not _is_grey(image, chosen.palette)]
    distances = [chosen.palette.residual(image[::4, ::4] / np.float32(255)) for image in colored]
    residual = float(np.mean(distances)) if distances else 0.0
    limit = _RESIDUAL_LIMIT if chosen.stated else _RESIDUAL_LIMIT_ASSUMED
    invert = residual <= limit and not options.keep_color
    unit: StoredUnit = COUNTS if options.range is None else "centikelvin"  # type: ignore[assignment]
    rows = []
    for file, name in tracked(zip(files, names), "importing thermal images", len(files)):
        target = _target(capture, name)
        if not target.exists():
            image = options.upright(file.read())
            write_png(target, _levels(image, chosen.palette, options.range) if invert else image)
        rows.append(_row(target.name, file, read_image(target)))
    if invert:
        _state(capture, unit)
    return rows, _picture_sentences(residual, limit, bool(colored), invert, options, chosen.stated)


def _levels(image: NDArray[Any], palette: Palette, span: tuple[float, float] | None) -> NDArray[np.uint16]:
    if image.ndim == 2:
        intensity = np.asarray(image / np.float32(np.iinfo(image.dtype).max), np.float32)
    elif _is_grey(image, palette):
        intensity = np.asarray(image[..., 1] / np.float32(255), np.float32)
    else:
        intensity = palette.to_intensity(image)
    if span is None:
        return np.rint(intensity * np.float32(65535)).astype(np.uint16)
    celsius = span[0] + intensity.astype(np.float64) * (span[1] - span[0])
    return np.rint((celsius + ZERO_CELSIUS) * STEPS_PER_KELVIN["centikelvin"]).clip(0, 65535).astype(np.uint16)


def _is_grey(image: NDArray[Any], palette: Palette) -> bool:
    """Whether a picture [H, W, ...] is white-hot, and not one in a palette."""
    if image.ndim == 2:
        return True
    colors = image[::4, ::4] / np.float32(255)
    return GREY.residual(colors) <= min(_GREY_LIMIT, palette.residual(colors))


def _picture_sentences(
    residual: float, limit: float, colored: bool, invert: bool, options: ThermalOptions, stated: bool
) -> list[str]:
    which = "their palette" if stated else "FLIR Iron, which is assumed"
    if not invert and residual > limit:
        return [
            f"Colours of the thermal pictures lie {residual:.0f} of 255 levels off {which}, so they stay colours "
            "without values. Give their palette with --palette FILE, or export radiometric files."
        ]
    if not invert:
        return ["Thermal pictures stay pseudo-colour, as --keep-color asks."]
    how = f" by the inverse of {which}, from which they lie {residual:.1f} of 255 levels" if colored else ""
    degrees = ""
    if options.range is None:
        degrees = (
            " They are no temperatures, and differ between images if the camera spreads its colours anew in each. "
            "--range MIN MAX states the °C of the palette's ends; radiometric files are better."
        )
    return [f"Thermal pictures were turned into values{how}.{degrees}"]


def _target(capture: CaptureFolder, name: str) -> Path:
    return capture.images(OTHER) / f"{name}.png"


def _row(name: str, file: SourceFile, image: NDArray[Any]) -> FrameRow:
    return file.row(OTHER, name, image.shape[1], image.shape[0])


def _state(capture: CaptureFolder, unit: str) -> None:
    write_bytes(capture.units_json, (json.dumps({"unit": unit}) + "\n").encode())


def _stated_unit(capture: CaptureFolder) -> str | None:
    try:
        return json.loads(read_regular(capture.units_json))["unit"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
