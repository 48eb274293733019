"""The thermal files of a capture's frames: read, and interpreted with what the capture says of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config import ThermalConfig
from thermosplat.datasets.capture_palette import choose_palette
from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.image_files import read_images
from thermosplat.datasets.image_folders import thermal_folder
from thermosplat.datasets.temperature_units import RadiometricStatement, read_statement
from thermosplat.datasets.thermal_images import ThermalFile, ThermalReading, interpret, is_radiometric
from thermosplat.errors import UserError


def read_each(shots: Sequence[Shot | None]) -> list[NDArray[Any] | None]:
    """Images of the shots there are."""
    images = iter(read_images([shot.path for shot in shots if shot is not None]))
    return [None if shot is None else next(images) for shot in shots]


def read_thermal(frames: Sequence[FrameFiles]) -> list[ThermalFile | None]:
    """Thermal files of each frame: the displayable image, the radiometric values, or both.

    Raises:
        UserError: A file cannot be read, or one in thermal_raw/ holds colours in place of values.
    """
    shown = read_each([frame.thermal for frame in frames])
    raw_paths = [
        frame.thermal.raw if frame.thermal is not None and frame.thermal.raw != frame.thermal.path else None
        for frame in frames
    ]
    raws = iter(read_images([path for path in raw_paths if path is not None]))
    files: list[ThermalFile | None] = []
    for frame, image, raw_path in zip(frames, shown, raw_paths, strict=True):
        beside = None if raw_path is None else next(raws)
        if frame.thermal is None or image is None:
            files.append(None)
            continue
        if beside is not None and not is_radiometric(beside):
            raise UserError(
                f"{raw_path} is an 8-bit image; radiometric values are 16-bit or floating-point with one channel.",
                "Export radiometric files, or take it out of that folder: thermal/ alone will do.",
            )
        path = frame.thermal.path
        if is_radiometric(image):
            files.append(
                ThermalFile(path, None, image, path) if beside is None else ThermalFile(path, None, beside, raw_path)
            )
        else:
            files.append(ThermalFile(path, require_8bit(path, image), beside, raw_path))
    return files


def interpret_thermal(
    root: Path, files: Sequence[ThermalFile | None], listing: Listing, config: ThermalConfig
) -> ThermalReading | None:
    """`interpret` for the frames that have a thermal file; None if none has."""
    present = [file for file in files if file is not None]
    if not present:
        return None
    statement = RadiometricStatement()
    for folder in (root / "thermal_raw", thermal_folder(root)):
        if (folder / "units.json").is_file():
            statement = read_statement(folder / "units.json")
            break
    palette = choose_palette(root, config, [file.path for file in present])
    reading = interpret(present, config, palette=palette, statement=statement, grey_range=listing.celsius_range)
    pixels = iter(reading.pixels)
    return ThermalReading(reading.scale, tuple(None if file is None else next(pixels) for file in files), reading.notes)


def require_8bit(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    """The image, if it is 8-bit.

    Raises:
        UserError: It is not.
    """
    if image.dtype != np.uint8:
        raise UserError(
            f"{path} has {image.dtype} colour; 8-bit colour or one-channel radiometric images are expected."
        )
    return image
