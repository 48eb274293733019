"""How noisy the images of a spectrum are; sensor_facts.py says what that means.

The noise of an image is estimated from the image alone (Immerkær 1996): the mask [1 -2 1]ᵀ [1 -2 1] leaves noise and
little of the scene, and a mean |response| r of Gaussian noise stands for σ = √(π/2) r / 6. It does not see what is
constant along a row or column, as the stripes of uncooled sensors are, so those are estimated by themselves: second
differences across the stripes, averaged along them without their outer quarters, which edges of the scene fill.
"""

import math
from dataclasses import dataclass
from statistics import median

from torch import Tensor

from thermosplat.training.frames.train_frames import TrainFrames

_FROM_MEAN = math.sqrt(math.pi / 2.0)
"""Standard deviation over mean absolute value of a normal distribution."""
_FROM_MEDIAN = 1.0 / 0.6744897501960817
"""Standard deviation over median absolute value of a normal distribution."""
_VIEWS = 16
"""Most images that are looked at, spread over all."""


@dataclass(frozen=True)
class ImageNoise:
    """Standard deviations of the noise of images, of the range 0 to 1."""

    pixels: float
    """That differs from pixel to pixel."""
    stripes: float
    """Of rows and columns."""
    plain: float
    """As ``pixels``, where the scene is plain: by the median of the responses in place of their mean, which texture
    raises. Less than all noise where that differs from place to place, as in dark parts of photographs."""

    @property
    def total(self) -> float:
        """Of both together."""
        return math.hypot(self.pixels, self.stripes)


def image_noise(image: Tensor, mask: Tensor | None = None) -> ImageNoise:
    """The noise of one image, mean over its channels.

    Args:
        image: [H, W, C] in 0 to 1, H and W at least 3.
        mask: bool [H, W], which pixels count; None: all. Those beyond have the noise of stripes alone.
    """
    across, down = image.diff(n=2, dim=1), image.diff(n=2, dim=0)
    response = across.diff(n=2, dim=0).flatten(0, 1)
    if mask is not None and bool((counts := _whole_neighbourhoods(mask).flatten()).any()):
        response = response[counts]
    stripes = math.hypot(_stripes(across, along=0), _stripes(down, along=1))
    plain = _FROM_MEDIAN * response.abs().median(dim=0).values / 6.0  # of each channel
    return ImageNoise(_FROM_MEAN * response.abs().mean().item() / 6.0, stripes, math.sqrt(plain.square().mean().item()))


def training_noise(frames: TrainFrames, spectrum: str) -> ImageNoise | None:
    """The median over training images of a spectrum; None where there are none."""
    having = [index for index, frame in enumerate(frames.frames) if spectrum in frame.views]
    chosen = having[:: math.ceil(len(having) / _VIEWS)] if having else []
    views = (frames[index].views[spectrum] for index in chosen)
    found = [image_noise(view.image, view.mask) for view in views if view.image is not None]
    if not found:
        return None
    return ImageNoise(
        median(noise.pixels for noise in found),
        median(noise.stripes for noise in found),
        median(noise.plain for noise in found),
    )


def _whole_neighbourhoods(mask: Tensor) -> Tensor:
    """Where the 3x3 pixels of a response all count, bool [H - 2, W - 2]."""
    return mask.unfold(0, 3, 1).unfold(1, 3, 1).flatten(2).all(dim=-1)


def _stripes(differences: Tensor, *, along: int) -> float:
    """σ of stripes along a dimension, of second differences across it."""
    length = differences.shape[along]
    middle = differences.sort(dim=along).values.narrow(along, length // 4, length - 2 * (length // 4))
    return _FROM_MEAN * middle.mean(dim=along).abs().mean().item() / math.sqrt(6.0)
