"""How the file of an exposure becomes an image to train on, once it is known what a spectrum's files are."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.class_colors import UNLABELLED, colors_of
from thermosplat.datasets.images.dead_pixels import DEAD_WINDOW
from thermosplat.datasets.images.image_files import resize
from thermosplat.datasets.images.masks import joined
from thermosplat.errors import UserError
from thermosplat.spectra import CELSIUS
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermal.temperature_units import ABSOLUTE_ZERO, measured_unit, to_measured


@dataclass(frozen=True, eq=False)
class SpectrumFile:
    """An exposure as read: the displayable image, the radiometric values, or both.

    Args:
        path: File of the displayable image, or of the values where there is no other; for messages.
        display: uint8 [H, W] grey or [H, W, 3] colour.
        raw: [H, W] radiometric values.
        mask: bool [H, W], where pixels of the displayable image count; None: everywhere.
        raw_mask: The same of the radiometric values.
    """

    path: Path
    display: NDArray[np.uint8] | None
    raw: NDArray[Any] | None = None
    raw_path: Path | None = None
    mask: NDArray[np.bool_] | None = None
    raw_mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class SpectrumPixels:
    """An exposure to train on.

    Args:
        image: uint8 [H, W, 3] for photographs and pseudo-colours; float32 [H, W, 1] in [0, 1] for one value per pixel.
        values: float32 [H, W], measured values in the unit of the spectrum's scale, where the data has them.
        mask: bool [H, W], where pixels count; None: everywhere.
        exact: Pixels have no mean between them, such as colours of classes.
    """

    image: NDArray[np.uint8] | NDArray[np.float32]
    values: NDArray[np.float32] | None
    mask: NDArray[np.bool_] | None = None
    exact: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, eq=False)
class PixelMeaning:
    """What the files of one spectrum are, the same for all of them.

    Args:
        kind: "photograph" and "color": their colours as they are. "grey": level / 255. "raw": radiometric values
            between `ends`. "labels": levels are classes, which have colours.
            "stack": channels in a basis.
        scale: What the pixels mean.
        unit: Unit of radiometric values in the files.
        factor: What those are multiplied by.
        ends: Values that become 0 and 1, of kind "raw".
        classes: How many there are, of kind "labels".
    """

    kind: Literal["photograph", "color", "grey", "raw", "labels", "stack"]
    scale: PixelScale
    unit: str
    factor: float = 1.0
    ends: tuple[float, float] = (0.0, 1.0)
    classes: int = 0

    @property
    def of_values(self) -> bool:
        """The image is made of the radiometric file, not of the displayable one."""
        return self.kind == "raw"

    @property
    def has_colors(self) -> bool:
        """The image has three channels of 8 bits, not one of float32."""
        return self.kind in ("photograph", "color", "labels")

    def described(self) -> tuple[object, ...]:
        """Everything that decides about pixels, in a form whose ``repr`` has every digit."""
        scale = self.scale
        palette = () if not scale.has_intensity else tuple(scale.palette.colors.ravel().tolist())
        return self.kind, scale.kind, scale.range, scale.unit, palette, self.unit, self.factor, self.ends

    def pixels(self, file: SpectrumFile) -> SpectrumPixels | None:
        """The image of an exposure, at its file's size; None where it lacks the file that images are made of."""
        if self.of_values:
            return None if file.raw is None else self._of_values(file.raw, file.raw_mask)
        if self.kind == "labels":
            return self._of_classes(file)
        if file.display is None:
            return None
        if self.kind == "photograph":
            return SpectrumPixels(file.display, None, file.mask)
        values = self._values_beside(file)
        if self.kind == "color":
            return SpectrumPixels(three_channels(file.display), values, file.mask)
        grey = file.display if file.display.ndim == 2 else file.display[..., 1]
        image = np.asarray(grey[..., None] / np.float32(255), np.float32)
        if values is None and self.scale.measured_unit is not None:
            values = self.scale.value(image[..., 0])
        return SpectrumPixels(image, values, file.mask)

    def _of_values(self, raw: NDArray[Any], mask: NDArray[np.bool_] | None) -> SpectrumPixels:
        low, high = self.ends
        values = measured_values(raw, self.unit, self.factor)
        width = max(high - low, 1e-6)
        image = np.asarray(np.clip((values - low) / width, 0, 1)[..., None], np.float32)
        return SpectrumPixels(image, None if measured_unit(self.unit) is None else values, mask)

    def _of_classes(self, file: SpectrumFile) -> SpectrumPixels:
        """Colours of classes; pixels of none do not count."""
        numbers = file.display
        if numbers is None or numbers.ndim != 2:
            raise UserError(
                f"{file.path} is no label image: it has colours, or more than 8 bits.",
                f"Expected is 8-bit grey, each level the number of a class, {UNLABELLED} where there is none.",
            )
        counts = numbers != UNLABELLED
        if (unknown := numbers[counts & (numbers >= self.classes)]).size:
            raise UserError(
                f"{file.path} has pixels of class {unknown[0]}, and the spectrum has {self.classes} classes (0 to "
                f"{self.classes - 1}).",
                f"Name all of them in its classes, or write {UNLABELLED} for pixels of no class.",
            )
        mask = joined([file.mask, counts])
        return SpectrumPixels(np.stack(colors_of(numbers), axis=-1), None, mask, exact=True)

    def _values_beside(self, file: SpectrumFile) -> NDArray[np.float32] | None:
        """Measured values of the radiometric file, at the size of the displayable image."""
        if file.raw is None or file.display is None:
            return None
        values = to_measured(file.raw, self.unit, self.factor)
        if values is not None and file.raw_mask is not None:
            values = np.where(file.raw_mask, values, np.float32(np.nan))
        return None if values is None else resize(values, file.display.shape[1], file.display.shape[0])


def check_finite(file: SpectrumFile) -> None:
    """Refuse radiometric values that are no numbers.

    Raises:
        UserError: Some are not finite, as those are that the file calls NoData.
    """
    if file.raw is None or file.raw.dtype.kind != "f" or np.isfinite(file.raw).all():
        return
    raise _without_value(file, int((~np.isfinite(file.raw)).sum()), "are not finite numbers or NoData")


def check_temperatures(file: SpectrumFile, unit: str) -> None:
    """Refuse radiometric values that no temperature can have; lone dead pixels pass.

    Raises:
        UserError: Pixels beside each other lie at absolute zero or below.
    """
    if file.raw is None or measured_unit(unit) != CELSIUS:
        return
    celsius = measured_values(file.raw, unit, 1.0)
    cold = celsius <= ABSOLUTE_ZERO
    if cold.any() and cv2.medianBlur(np.ascontiguousarray(celsius), DEAD_WINDOW).min() <= ABSOLUTE_ZERO:
        least = float(file.raw[cold].min())
        raise _without_value(file, int(cold.sum()), f"lie at absolute zero or below ({least:,.6g}, read as {unit})")


def _without_value(file: SpectrumFile, count: int, what: str) -> UserError:
    return UserError(
        f"{file.raw_path or file.path} has {count:,} pixels without a value: they {what}.",
        "Fill them, export the file again, or say with a mask that they do not count (docs/data-layouts.md).",
    )


def measured_values(raw: NDArray[Any], unit: str, factor: float) -> NDArray[np.float32]:
    """Values of a file [H, W] in the unit in which they are reported, or as they are where they have none."""
    raw = np.asarray(raw)
    measured = to_measured(raw, unit, factor)
    return raw.astype(np.float32) if measured is None else measured


def three_channels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey as colour, [H, W, 3]."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)
