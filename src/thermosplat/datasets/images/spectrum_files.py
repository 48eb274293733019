"""The image files of one spectrum of a capture: read, and interpreted with what the capture says of them."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.images.capture_palette import choose_palette
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.image_folders import image_folder, spectrum_folder, values_folder
from thermosplat.datasets.images.pixel_meaning import PixelMeaning, SpectrumFile
from thermosplat.datasets.images.spectrum_images import SpectrumReading, interpret, is_radiometric
from thermosplat.errors import UserError
from thermosplat.spectra import COUNTS, Source, SpectrumConfig
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermal.temperature_units import RadiometricStatement, may_be_temperature, read_statement


def read_spectrum(
    root: Path,
    name: str,
    spectrum: SpectrumConfig,
    frames: Sequence[FrameFiles],
    listing: Listing,
    ranging: Sequence[SpectrumFile] | None = None,
) -> SpectrumReading | None:
    """The images of one spectrum of each frame; None if no frame has one.

    Args:
        root: The capture's folder.
        name: The spectrum's name.
        spectrum: Its settings.
        frames: The frames.
        listing: What the layout knows of the capture.
        ranging: Exposures whose values decide the range, where `frames` are not all; as of ``interpret``.

    Raises:
        UserError: A file cannot be read, or is not what the settings ask for.
    """
    if not any(name in frame.shots for frame in frames):
        return None
    files = _read_files([frame.shots.get(name) for frame in frames], spectrum.source)
    present = [file for file in files if file is not None]
    displays = tuple(None if file is None else file.display for file in files)
    if spectrum.source == "photograph":
        meaning = PixelMeaning("photograph", PixelScale("photograph"), COUNTS)
        return SpectrumReading(meaning, tuple(f if f is None else meaning.pixels(f) for f in files), (), displays)
    statement = RadiometricStatement()
    if may_be_temperature(spectrum.unit):
        below_images = spectrum_folder(image_folder(root, "images"), name, spectrum)
        for folder in (values_folder(root, name, spectrum), spectrum_folder(root, name, spectrum), below_images):
            if (folder / "units.json").is_file():
                statement = read_statement(folder / "units.json", name)
                break
    palette = choose_palette(root, name, spectrum, [file.path for file in present])
    reading = interpret(
        name,
        present,
        spectrum,
        palette=palette,
        statement=statement,
        grey_range=listing.celsius_range,
        ranging=ranging,
    )
    pixels = iter(reading.pixels)
    return SpectrumReading(
        reading.meaning, tuple(None if file is None else next(pixels) for file in files), reading.notes, displays
    )


def _read_files(shots: Sequence[Shot | None], source: Source) -> list[SpectrumFile | None]:
    """``read_shot`` of each, several at a time; None where there is none."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda shot: None if shot is None else read_shot(shot, source), shots))


def read_shot(shot: Shot, source: Source) -> SpectrumFile:
    """The files of one exposure: the displayable image, the values, or both.

    Args:
        shot: The exposure.
        source: What the spectrum's images are; of a photograph values beside it are not looked at.

    Raises:
        UserError: A file cannot be read, is no photograph, or holds colours in place of the values that belong there.
    """
    path, image = shot.path, read_image(shot.path)
    if source == "photograph":
        return SpectrumFile(path, _as_rgb(path, image))
    raw_path = None if shot.raw == path else shot.raw
    beside = None if raw_path is None else read_image(raw_path)
    if beside is not None and not is_radiometric(beside):
        raise UserError(
            f"{raw_path} is {_in_words(beside)}; radiometric values are 16-bit or floating-point with one channel.",
            f"Export radiometric files, or take it out of that folder: {path.parent.name}/ alone will do.",
        )
    if is_radiometric(image):
        return SpectrumFile(path, None, image, path) if beside is None else SpectrumFile(path, None, beside, raw_path)
    return SpectrumFile(path, _require_8bit(path, image), beside, raw_path)


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
