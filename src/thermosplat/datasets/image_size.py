"""At which size images are trained: divided by a whole number, or as large as is of use."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from thermosplat.config import ImageSize
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.lens import shrunk

LONGEST_SIDE = 1600
"""[px] of images with "auto". The code of 3DGS shrinks wider ones to this width, and says how it is told otherwise."""


@dataclass(frozen=True)
class TrainedSize:
    """What makes images smaller.

    Args:
        factor: Divides the sides of all images.
        longest: Longest side [px] that images have then; "auto": 1,600, or any where a factor is given.
    """

    factor: int
    longest: ImageSize

    def divisor(self, width: int, height: int) -> float:
        """What the sides of an image are divided by.

        Args:
            width: Of the image as it is stored [px].
            height: The same.
        """
        if self.longest == "auto":
            longest = LONGEST_SIDE if self.factor == 1 else max(width, height)
        else:
            longest = self.longest
        return max(float(self.factor), max(width, height) / longest)

    def shrunk(self, camera: Camera) -> Camera:
        """The camera of an image that is made smaller so."""
        return shrunk(camera, self.divisor(camera.width, camera.height))

    def notes(self, images: Iterable[tuple[Path, int, int]]) -> list[str]:
        """A line on images that are too large, of which nobody has said anything.

        Args:
            images: File, width and height [px] of each.
        """
        large = [(path, width, height) for path, width, height in images if max(width, height) > LONGEST_SIDE]
        if self.longest != "auto" or self.factor != 1 or not large:
            return []
        path, width, height = large[0]
        divisor = self.divisor(width, height)
        return [
            f"{len(large)} images are trained at {LONGEST_SIDE:,} px, such as {path.name} of {width}x{height} at "
            f"{round(width / divisor)}x{round(height / divisor)}; --image-size says otherwise."
        ]
