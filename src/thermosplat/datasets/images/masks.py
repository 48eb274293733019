"""Masks: images that are black where the pixels of another image do not count.

They lie in ``masks/`` of the capture, under the name of their image (``0001.png``) or with its ending before their own
(``0001.jpg.png``, as COLMAP has it); those of a further spectrum in its folder there (``masks/thermal/0001.png``). A
transforms file may name them (``mask_path``). What is transparent in an image does not count either.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_files import IMAGE_SUFFIXES, list_images, read_image, resize
from thermosplat.datasets.images.image_folders import image_folder
from thermosplat.datasets.images.image_names import NamedImages, folders_of
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig, folder_names

FOLDER = "masks"
_ASPECT = 0.01
"""Relative difference of aspects up to which a mask of another size is of the same view, as images may be scaled."""

Mask = NDArray[np.bool_]


def masks_by_spectrum(root: Path, spectra: Mapping[str, SpectrumConfig]) -> dict[str, NamedImages[Path]]:
    """The masks of a capture, to be found by the names of their images.

    Args:
        spectra: The spectra; a mask in no folder of one is of the first.
    """
    folder, (leading, *others) = image_folder(root, FOLDER), spectra
    found: dict[str, list[tuple[PurePosixPath, Path]]] = {name: [] for name in spectra}
    for path in mask_files(root):
        name = PurePosixPath(path.relative_to(folder).as_posix())
        above = {part.lower() for part in name.parts[:-1]}
        owner = next((other for other in others if above & set(folder_names(other, spectra[other]))), leading)
        inner = name.with_suffix("")
        found[owner].append((inner if inner.suffix.lower() in IMAGE_SUFFIXES else name, path))
    folders = folders_of(spectra)
    return {name: NamedImages(f"{FOLDER}/", masks, folders=folders) for name, masks in found.items()}


def mask_files(root: Path) -> list[Path]:
    """All masks in the folder for them."""
    return list_images(image_folder(root, FOLDER), recursive=True)


def read_mask(path: Path, width: int, height: int) -> Mask:
    """Where pixels count: where a mask is not black.

    Args:
        path: The mask; colours are black where all of them are 0.
        width: Width of its image [px].
        height: Height of its image [px].

    Returns:
        bool [H, W]; of a mask of another size, a pixel counts that nothing black touches.

    Raises:
        UserError: It cannot be read, or has another aspect.
    """
    image = read_image(path)
    mask = np.any((image > 0).reshape(*image.shape[:2], -1), axis=-1)
    if abs(mask.shape[1] * height / (mask.shape[0] * width) - 1) > _ASPECT:
        raise UserError(
            f"The mask {path} is {mask.shape[1]}x{mask.shape[0]}, and its image {width}x{height}: another aspect.",
            "Make it anew from that image, or remove it.",
        )
    return whole_pixels(resize(levels_of_mask(mask), width, height))


def levels_of_mask(mask: Mask) -> NDArray[np.uint8]:
    """A mask as an image that can be resampled: 255 where pixels count."""
    return mask.astype(np.uint8) * np.uint8(255)


def whole_pixels(levels: NDArray[np.uint8]) -> Mask:
    """The mask of a resampled image: where all that a pixel is made of counts."""
    return levels == 255


def joined(masks: Sequence[Mask | None]) -> Mask | None:
    """Where pixels count in all masks; None where all do."""
    present = [mask for mask in masks if mask is not None]
    together = np.logical_and.reduce(present) if present else None
    return None if together is None or together.all() else together


def filled(values: NDArray[np.generic], mask: Mask | None) -> NDArray[np.generic]:
    """Values whose pixels that do not count have the median of the others, so that they set no range.

    Args:
        values: [H, W]; of those that count some may be no numbers.
        mask: Which count; None: all.
    """
    if mask is None:
        return values
    counting = values[mask]
    counting = counting[np.isfinite(counting)]
    middle = np.median(counting) if counting.size else 0
    return np.where(mask, values, np.asarray(middle).astype(values.dtype))
