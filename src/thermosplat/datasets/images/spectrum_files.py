"""The image files of one spectrum of a capture: read, and interpreted with what the capture says of them."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.images.capture_palette import choose_palette
from thermosplat.datasets.images.image_files import read_pixels
from thermosplat.datasets.images.image_folders import image_folder, spectrum_folder, values_folder
from thermosplat.datasets.images.masks import Mask, filled, joined, read_mask
from thermosplat.datasets.images.pixel_meaning import PixelMeaning, SpectrumFile
from thermosplat.datasets.images.spectrum_images import SpectrumReading, interpret, is_radiometric
from thermosplat.datasets.images.stack_images import read_stacks
from thermosplat.errors import UserError
from thermosplat.spectra import COUNTS, STACKS, Source, SpectrumConfig, label
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
        ranging: Exposures whose values decide the range, where `frames` are not all; as of ``interpret``.

    Raises:
        UserError: A file cannot be read, or is not what the settings ask for.
    """
    if not any(name in frame.shots for frame in frames):
        return None
    if spectrum.source in STACKS:
        return read_stacks([frame.shots.get(name) for frame in frames], spectrum)
    shots = [frame.shots.get(name) for frame in frames]
    with ThreadPoolExecutor() as pool:
        files = list(pool.map(lambda shot: None if shot is None else read_shot(shot, spectrum.source), shots))
    present = [file for file in files if file is not None]
    displays = tuple(None if file is None else file.display for file in files)
    if spectrum.source == "photograph":
        meaning = PixelMeaning("photograph", PixelScale("photograph"), COUNTS)
        pixels = tuple(file if file is None else meaning.pixels(file) for file in files)
        return SpectrumReading(meaning, pixels, tuple(_constant_notes(name, present)), displays)
    if spectrum.source == "labels":
        meaning = PixelMeaning("labels", PixelScale("labels"), COUNTS, classes=len(spectrum.classes))
        pixels = tuple(file if file is None else meaning.pixels(file) for file in files)
        return SpectrumReading(meaning, pixels, (), displays)
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
    read = iter(reading.pixels)
    pixels = tuple(None if file is None else next(read) for file in files)
    return SpectrumReading(reading.meaning, pixels, (*reading.notes, *_constant_notes(name, present)), displays)


def _constant_notes(name: str, files: Sequence[SpectrumFile]) -> list[str]:
    """A warning (none or one) of images that have one value everywhere."""
    constant = [file for file in files if _is_constant(file)]
    if not constant:
        return []
    have = "has" if len(constant) == 1 else "have"
    return [
        f"{len(constant)} of {len(files)} {label(name)} images {have} one value everywhere (first: "
        f"{constant[0].path.name}): a closed shutter, a covered lens or a damaged file? Nothing can be learnt there."
    ]


def _is_constant(file: SpectrumFile) -> bool:
    for image in (file.display, file.raw):
        if image is not None and all((part == image[0, 0]).all() for part in (image[::8, ::8], image)):
            return True
    return False


def read_shot(shot: Shot, source: Source) -> SpectrumFile:
    """The files of one exposure: the displayable image, the values, or both.

    Args:
        source: What the spectrum's images are; of a photograph values beside it are not looked at.

    Raises:
        UserError: A file cannot be read, is no photograph, or holds colours in place of the values that belong there.
    """
    path, image, mask = shot.path, *_read(shot.path, shot.mask)
    if source == "photograph":
        return SpectrumFile(path, as_rgb(path, image), mask=mask)
    raw_path = None if shot.raw == path else shot.raw
    beside, beside_mask = (None, None) if raw_path is None else _read(raw_path, shot.mask)
    if beside is not None and not is_radiometric(beside):
        raise UserError(
            f"{raw_path} is {_in_words(beside)}; radiometric values are 16-bit or floating-point with one channel.",
            f"Export radiometric files, or take it out of that folder: {path.parent.name}/ alone will do.",
        )
    if is_radiometric(image):
        if beside is None:
            return SpectrumFile(path, None, image, path, raw_mask=mask)
        return SpectrumFile(path, None, beside, raw_path, raw_mask=beside_mask)
    return SpectrumFile(path, _require_8bit(path, image), beside, raw_path, mask, beside_mask)


def _read(path: Path, mask_path: Path | None) -> tuple[NDArray[Any], Mask | None]:
    """An image and which of its pixels count. Values that do not have the median of the others."""
    pixels = read_pixels(path)
    height, width = pixels.image.shape[:2]
    mask = joined([pixels.mask, None if mask_path is None else read_mask(mask_path, width, height)])
    image = pixels.image
    if is_radiometric(image):
        image = filled(image, mask)
        if pixels.void is not None and (void := pixels.void if mask is None else pixels.void & mask).any():
            image = np.where(void, np.float32(np.nan), image)
    return image, mask


def _in_words(image: NDArray[Any]) -> str:
    """ "an 8-bit image", "an image of 3 channels (uint16)"."""
    if image.dtype == np.uint8:
        return "an 8-bit image"
    return f"an image of {image.shape[2] if image.ndim == 3 else 1} channels ({image.dtype})"


def as_rgb(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit RGB [H, W, 3] of a photograph: 16 bits are reduced, grey is repeated.

    Raises:
        UserError: It has other values.
    """
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    image = _require_8bit(path, image)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)


def _require_8bit(path: Path, image: NDArray[Any]) -> NDArray[np.uint8]:
    """The image, if it is 8-bit."""
    if image.dtype != np.uint8:
        raise UserError(
            f"{path} has {image.dtype} colour; 8-bit colour or one-channel radiometric images are expected."
        )
    return image
