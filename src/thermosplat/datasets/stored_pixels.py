"""Pixels of a view that stay on the disk until they are needed, and the way from a file's pixels to a view's."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.frame_files import Shot
from thermosplat.datasets.images.image_bytes import FileStamp, ImageHeader
from thermosplat.datasets.images.image_files import resize
from thermosplat.datasets.images.jpeg_warnings import check_jpegs, refusing_damage
from thermosplat.datasets.images.masks import levels_of_mask, whole_pixels
from thermosplat.datasets.images.pixel_meaning import (
    PixelMeaning,
    SpectrumPixels,
    check_finite,
    check_temperatures,
)
from thermosplat.datasets.images.spectrum_files import read_shot
from thermosplat.datasets.lens import Lens, rectification
from thermosplat.datasets.pixel_cache import PixelCache
from thermosplat.errors import UserError
from thermosplat.spectra import Source

_CHANNELS_AT_ONCE = 4
"""OpenCV resamples no more."""
_INVERTING_PIXELS = 1 << 18
"""The inverse of a palette takes 40 bytes for each of so many pixels at most: a table, and some pixels at a time."""


class ImageLostError(UserError):
    """An image that was there when the capture was read cannot be read any more, or is another one."""


class TrainedPixels(NamedTuple):
    """What a training step compares with."""

    image: NDArray[np.uint8] | NDArray[np.float32]
    """As ``SpectrumPixels.image``."""
    intensity: NDArray[np.float32] | None
    """Scalar intensity [H, W] of pseudo-colours; None of others, whose images say it themselves."""
    mask: NDArray[np.bool_] | None = None
    """As ``SpectrumPixels.mask``, where there may be one."""


@dataclass(frozen=True, eq=False)
class ImagesOnDisk:
    """Of a capture whose images stay on the disk.

    Args:
        memory: What images may take in the host's memory [bytes].
        cache: Keeps what was made of them.
    """

    memory: float
    cache: PixelCache


def seen_by(camera: Camera, lens: Lens | None, pixels: SpectrumPixels) -> SpectrumPixels:
    """Pixels of a file as the view's camera sees them: undistorted, and of its size.

    Args:
        lens: The lens whose distortion is taken out; None: it stays.
    """
    height, width, channels = pixels.image.shape
    ideal = None if lens is None else rectification(lens, width, height)

    def seen(array: NDArray[Any], *, exact: bool = False) -> NDArray[Any]:
        if array.ndim == 3 and array.shape[2] > _CHANNELS_AT_ONCE:
            starts = range(0, array.shape[2], _CHANNELS_AT_ONCE)
            parts = (seen(array[..., start : start + _CHANNELS_AT_ONCE], exact=exact) for start in starts)
            return np.dstack([*parts])
        ideally = array if ideal is None else ideal.apply(array, exact=exact)
        return resize(ideally, camera.width, camera.height, exact=exact)

    image = seen(pixels.image, exact=pixels.exact).reshape(camera.height, camera.width, channels)
    values = None if pixels.values is None else seen(pixels.values)
    mask = None if pixels.mask is None else whole_pixels(seen(levels_of_mask(pixels.mask)))
    if values is not None and mask is not None:
        values = np.where(mask, values, np.float32(np.nan))
    return SpectrumPixels(image, values, mask, pixels.exact)


@dataclass(frozen=True, eq=False)
class StoredPixels:
    """Where the pixels of one view are, and what they are.

    Args:
        camera: The view's, as the capture has it.
        lens: The lens whose distortion is taken out; None: it stays.
        cache: Keeps what was made of the files.
    """

    shot: Shot
    header: ImageHeader
    stamps: tuple[FileStamp, ...]
    source: Source
    meaning: PixelMeaning
    camera: Camera
    lens: Lens | None
    cache: PixelCache

    @property
    def channels(self) -> int:
        """Of the image."""
        return 3 if self.meaning.has_colors else 1

    @property
    def has_intensity(self) -> bool:
        """Training needs a scalar intensity beside the image: of pseudo-colours."""
        return self.meaning.kind == "color"

    @property
    def may_be_masked(self) -> bool:
        """Pixels may be masked: there is a mask, the file has an alpha channel or the like, or some are of no class."""
        return self.shot.mask is not None or self.header.has_alpha or self.meaning.kind == "labels"

    @property
    def trained_bytes(self) -> int:
        """Memory that ``read_to_train`` returns [bytes]."""
        per_pixel = 4
        if self.meaning.has_colors:
            per_pixel = 7 if self.has_intensity else 3
        return (per_pixel + self.may_be_masked) * self.camera.width * self.camera.height

    @property
    def kept_bytes(self) -> int:
        """What the disk cache keeps of it, at most [bytes]: measured values, too."""
        values = 0 if self.meaning.kind == "photograph" else 4 * self.camera.width * self.camera.height
        return self.trained_bytes + values

    @property
    def reading_bytes(self) -> int:
        """Memory that reading takes, about [bytes]: the file, the image in both orders of its colours, the resampled
        one; or what the inverse of a palette computes. The maps of a lens are not in it."""
        inverting = 40 * min(self.camera.width * self.camera.height, _INVERTING_PIXELS)
        in_color = self.trained_bytes + inverting if self.has_intensity else 0
        return max(4 * self.header.decoded_bytes, in_color)

    @property
    def map_bytes(self) -> int:
        """Memory of the maps that undistort it [bytes]; images of one lens share them."""
        return 8 * self.camera.width * self.camera.height if self.lens is not None and self.lens.distorted else 0

    @cached_property
    def key(self) -> str:
        """A name of what the pixels are made of."""
        made_of = (*self.shot.files, self.stamps, self.source, self.lens, self.camera)
        return hashlib.sha256(repr((made_of, self.meaning.described())).encode("utf-8", "replace")).hexdigest()[:32]

    def read(self) -> SpectrumPixels:
        """Image and measured values.

        Raises:
            ImageLostError: A file cannot be read, or its image is not what it was.
        """
        kept, values, mask = (self.cache.load(self.key, part) for part in ("image", "values", "mask"))
        lost = (values is None and self.cache.has(self.key, "values")) or (mask is None and self.may_be_masked)
        if kept is not None and not lost:
            return SpectrumPixels(kept, values, mask)
        try:
            with refusing_damage(self.shot.path):
                pixels = self._pixels_of_files()
        except UserError as error:
            raise ImageLostError(error.message, "Restore it.") from error
        if pixels.values is not None:
            self.cache.keep(self.key, "values", pixels.values)
        if self.may_be_masked:
            mask = np.ones(pixels.image.shape[:2], np.bool_) if pixels.mask is None else pixels.mask
            pixels = replace(pixels, mask=mask)
            self.cache.keep(self.key, "mask", mask)
        self.cache.keep(self.key, "image", pixels.image)  # last: where it is, all is
        return pixels

    def read_to_train(self) -> TrainedPixels:
        """What a training step compares with.

        Raises:
            ImageLostError: As ``read``.
        """
        image, mask = (self.cache.load(self.key, part) for part in ("image", "mask"))
        if image is None or (mask is None and self.may_be_masked):
            pixels = self.read()
            image, mask = pixels.image, pixels.mask
        if not self.has_intensity:
            return TrainedPixels(image, None, mask)
        intensity = self.cache.load(self.key, "intensity")
        if intensity is None:
            intensity = self.meaning.scale.palette.to_intensity(np.asarray(image, np.uint8))
            self.cache.keep(self.key, "intensity", intensity)
        return TrainedPixels(image, intensity, mask)

    def read_into(self, parts: TrainedPixels) -> None:
        """Write what a training step compares with to memory that is there.

        Args:
            parts: Arrays, each in one piece, of the shapes and types of what ``read_to_train`` returns.

        Raises:
            ImageLostError: As ``read``.
        """
        wanted = {name: array for name, array in parts._asdict().items() if array is not None}
        if all(self.cache.load_into(self.key, name, array) for name, array in wanted.items()):
            return
        found = self.read_to_train()._asdict()
        for name, array in wanted.items():
            array[...] = found[name]

    @property
    def is_kept(self) -> bool:
        """The disk cache has the image."""
        return self.cache.has(self.key, "image")

    def prepare(self) -> None:
        """Compute what reading needs of the lens; images of one camera share it."""
        if self.lens is not None:
            rectification(self.lens, self.header.width, self.header.height)

    def check(self) -> None:
        """Refuse a damaged JPEG file before it is read, where this process decodes for several threads.

        Raises:
            ImageLostError: It is damaged.
        """
        if not self.is_kept:
            try:
                check_jpegs(self.shot.files)
            except (UserError, OSError) as error:
                raise ImageLostError(getattr(error, "message", str(error)), "Restore it.") from error

    def _pixels_of_files(self) -> SpectrumPixels:
        file = read_shot(self.shot, self.source)
        check_finite(file)
        check_temperatures(file, self.meaning.unit)
        pixels = self.meaning.pixels(file)
        expected = f"{self.header.width}x{self.header.height}"
        if pixels is None:
            raise UserError(f"{self.shot.path} is no longer of the kind that it was when the training began.")
        height, width = pixels.image.shape[:2]
        if (width, height) != (self.header.width, self.header.height):
            raise UserError(f"{self.shot.path} is {width}x{height}, and it was {expected} when the training began.")
        return seen_by(self.camera, self.lens, pixels)
