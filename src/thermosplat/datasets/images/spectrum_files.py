"""The image files of one spectrum of a capture: read, and interpreted with what the capture says of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.frame_files import FrameFiles, Listing
from thermosplat.datasets.images.capture_palette import choose_palette
from thermosplat.datasets.images.image_files import read_images
from thermosplat.datasets.images.image_folders import image_folder, spectrum_folder, values_folder
from thermosplat.datasets.images.spectrum_images import (
    SpectrumFile,
    SpectrumPixels,
    SpectrumReading,
    interpret,
    is_radiometric,
)
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermal.temperature_units import RadiometricStatement, may_be_temperature, read_statement


def read_spectrum(
    root: Path, name: str, spectrum: SpectrumConfig, frames: Sequence[FrameFiles], listing: Listing
) -> SpectrumReading | None:
    """The images of one spectrum of each frame; None if no frame has one.

    Args:
        root: The capture's folder.
        name: The spectrum's name.
        spectrum: Its settings.
        frames: The frames.
        listing: What the layout knows of the capture.

    Raises:
        UserError: A file cannot be read, or is not what the settings ask for.
    """
    if not any(name in frame.shots for frame in frames):
        return None
    if spectrum.source == "photograph":
        return _photographs(name, frames)
    files = _read_files(name, frames)
    present = [file for file in files if file is not None]
    statement = RadiometricStatement()
    if may_be_temperature(spectrum.unit):
        below_images = spectrum_folder(image_folder(root, "images"), name, spectrum)
        for folder in (values_folder(root, name, spectrum), spectrum_folder(root, name, spectrum), below_images):
            if (folder / "units.json").is_file():
                statement = read_statement(folder / "units.json", name)
                break
    palette = choose_palette(root, name, spectrum, [file.path for file in present])
    reading = interpret(name, present, spectrum, palette=palette, statement=statement, grey_range=listing.celsius_range)
    pixels = iter(reading.pixels)
    displays = tuple(None if file is None else file.display for file in files)
    return SpectrumReading(
        reading.scale, tuple(None if file is None else next(pixels) for file in files), reading.notes, displays
    )


def _photographs(name: str, frames: Sequence[FrameFiles]) -> SpectrumReading:
    """Colours as they are: 8-bit RGB."""
    paths = [frame.shots[name].path if name in frame.shots else None for frame in frames]
    images = iter(read_images([path for path in paths if path is not None]))
    pixels = tuple(None if path is None else SpectrumPixels(_as_rgb(path, next(images)), None) for path in paths)
    displays = tuple(None if exposure is None else exposure.image for exposure in pixels)
    return SpectrumReading(PixelScale("photograph"), pixels, (), displays)  # type: ignore[arg-type]


def _read_files(name: str, frames: Sequence[FrameFiles]) -> list[SpectrumFile | None]:
    """Files of each frame: the displayable image, the values, or both.

    Raises:
        UserError: A file cannot be read, or one beside the displayable image holds colours in place of values.
    """
    shots = [frame.shots.get(name) for frame in frames]
    shown = iter(read_images([shot.path for shot in shots if shot is not None]))
    beside_paths = [None if shot is None or shot.raw == shot.path else shot.raw for shot in shots]
    raws = iter(read_images([path for path in beside_paths if path is not None]))
    files: list[SpectrumFile | None] = []
    for shot, raw_path in zip(shots, beside_paths, strict=True):
        if shot is None:
            files.append(None)
            continue
        image, beside = next(shown), None if raw_path is None else next(raws)
        if beside is not None and not is_radiometric(beside):
            raise UserError(
                f"{raw_path} is {_in_words(beside)}; radiometric values are 16-bit or floating-point with one channel.",
                f"Export radiometric files, or take it out of that folder: {shot.path.parent.name}/ alone will do.",
            )
        path = shot.path
        if is_radiometric(image):
            files.append(
                SpectrumFile(path, None, image, path) if beside is None else SpectrumFile(path, None, beside, raw_path)
            )
        else:
            files.append(SpectrumFile(path, _require_8bit(path, image), beside, raw_path))
    return files


def _in_words(image: NDArray[Any]) -> str:
    """ "an 8-bit image", "an image of 3 channels (uint16)"."""
    if image.dtype == np.uint8:
        return "an 8-bit image"
    return f"an image of {image.shape[2] if image.ndim == 3 else 1} channels ({image.dtype})"


def _as_rgb(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit RGB of a photograph: 16 bits are reduced, grey is repeated."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    image = _require_8bit(path, image)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)


def _require_8bit(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    """The image, if it is 8-bit.

    Raises:
        UserError: It is not.
    """
    if image.dtype != np.uint8:
        raise UserError(
            f"{path} has {image.dtype} colour; 8-bit colour or one-channel radiometric images are expected."
        )
    return image
