"""How far each spectrum's camera blurs what it sees: a Gaussian whose width is learnt with the scene.

A thermal camera's pixels are large, and its lens diffracts waves twenty times as long as light's. So its images are
softer than photographs of the same place. Decoders see one pixel at a time, and Gaussians have one shape for all
spectra. Without a point spread they can show a soft edge only where surfaces fade, which other views contradict.
"""

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from thermosplat.fused.point_spread import blurred_by_gaussian
from thermosplat.spectra import Spectrum

REACH = 4.0
"""Pixels count up to this many times the deviation that training begins with. Open choice: of a blur that turns out to
be twice as wide a twentieth is left out."""


class PointSpreads(nn.Module):
    """Point spreads by spectrum.

    Attributes:
        log_widths: Logarithm of the Gaussian's standard deviation [of an image's width], scalars, of the spectra that
            have one (``SpectrumConfig.point_spread``).

    Args:
        spectra: The spectra of the model.
    """

    def __init__(self, spectra: Iterable[Spectrum]) -> None:
        super().__init__()
        self._first = {one.name: one.point_spread for one in spectra if one.point_spread > 0}
        self.log_widths = nn.ParameterDict(
            {name: nn.Parameter(torch.tensor(math.log(width))) for name, width in self._first.items()}
        )

    def forward(self, spectrum: str, image: Tensor) -> Tensor:
        """What the camera makes of an image, or of the features that it is decoded from.

        Args:
            spectrum: Its name.
            image: Shape [H, W, C].
        """
        if spectrum not in self._first:
            return image
        width = image.shape[1]
        radius = max(1, math.ceil(REACH * self._first[spectrum] * width))
        return blurred_by_gaussian(image, self.log_widths[spectrum].exp() * width, radius)

    def widths(self) -> dict[str, float]:
        """Standard deviations by spectrum [of an image's width]."""
        return {name: value.exp().item() for name, value in self.log_widths.items()}
