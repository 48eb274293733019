"""How far each spectrum's camera blurs what it sees: a Gaussian whose width is learnt with the scene.

A thermal camera's pixels are large, and its lens diffracts waves twenty times as long as light's. So its images are
softer than photographs of the same place. Decoders see one pixel at a time, and Gaussians have one shape for all
spectra. Without a point spread they can show a soft edge only where surfaces fade, which other views contradict.
"""

import math

import torch
from torch import Tensor, nn

from thermosplat.fused.point_spread import blurred_by_gaussian

REACH = 4.0
"""Pixels count up to this many times the deviation that training begins with. Open choice: of a blur that turns out to
be twice as wide a twentieth is left out."""


class PointSpread(nn.Module):
    """The point spread of one spectrum's camera.

    Attributes:
        log_width: Logarithm of the Gaussian's standard deviation [of an image's width], a scalar.

    Args:
        width: The standard deviation that training begins with (``SpectrumConfig.point_spread``), > 0.
    """

    def __init__(self, width: float) -> None:
        super().__init__()
        self._first = width
        self.log_width = nn.Parameter(torch.tensor(math.log(width)))

    def forward(self, image: Tensor) -> Tensor:
        """What the camera makes of an image, or of the features that it is decoded from.

        Args:
            image: Shape [H, W, C].
        """
        pixels = image.shape[1]
        radius = max(1, math.ceil(REACH * self._first * pixels))
        return blurred_by_gaussian(image, self.log_width.exp() * pixels, radius)

    @property
    def width(self) -> float:
        """Standard deviation [of an image's width]."""
        return self.log_width.exp().item()
