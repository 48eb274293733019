"""A distorted camera, whose images are made of a wider pinhole camera's."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Lens:
    """A camera of OPENCV's model with one focal length; pixel centres at halves."""

    width: int
    height: int
    focal: float
    cx: float
    cy: float
    k1: float
    k2: float
    margin: float
    """How much wider than the image the pinhole render is."""

    @property
    def rendered_size(self) -> tuple[int, int]:
        """Width and height of the pinhole render."""
        return 2 * round(self.width * self.margin / 2), 2 * round(self.height * self.margin / 2)

    @property
    def fov(self) -> float:
        """Of the pinhole render, across [degrees]."""
        return float(np.degrees(2 * np.arctan(self.rendered_size[0] / 2 / self.focal)))

    def bent(self, render: NDArray[Any]) -> NDArray[Any]:
        """The picture that the camera takes of what the pinhole render saw."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        matrix = np.array([[self.focal, 0, self.cx - 0.5], [0, self.focal, self.cy - 0.5], [0, 0, 1]])
        bent = np.array([self.k1, self.k2, 0, 0])
        xy = cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), matrix, bent)
        xy = xy.reshape(self.height, self.width, 2)
        width, height = self.rendered_size
        columns = (self.focal * xy[..., 0] + width / 2 - 0.5).astype(np.float32)
        rows = (self.focal * xy[..., 1] + height / 2 - 0.5).astype(np.float32)
        return cv2.remap(render, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def described(self) -> dict[str, Any]:
        """As truth.json has it."""
        shape = {"model": "OPENCV", "width": self.width, "height": self.height, "fx": self.focal, "fy": self.focal}
        return {**shape, "cx": self.cx, "cy": self.cy, "k1": self.k1, "k2": self.k2, "p1": 0, "p2": 0}

    def scaled(self, factor: float) -> "Lens":
        """The same lens before more or fewer pixels."""
        width, height = round(self.width * factor), round(self.height * factor)
        places = self.focal * factor, self.cx * factor, self.cy * factor
        return Lens(width, height, *places, self.k1, self.k2, self.margin)
