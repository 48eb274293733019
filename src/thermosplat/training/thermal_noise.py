"""How noisy the thermal images are, and the smoothness that much noise asks for.

The noise of an image is estimated from the image alone (Immerkær 1996): the mask [1 -2 1]ᵀ [1 -2 1] leaves noise and
little of the scene, and a mean |response| r of Gaussian noise stands for σ = √(π/2) r / 6. It does not see what is
constant along a row or column, as the stripes of uncooled sensors are, so those are estimated by themselves: second
differences across the stripes, averaged along them without their outer quarters, which edges of the scene fill.
"""

import math
from dataclasses import dataclass, replace
from statistics import median

from torch import Tensor

from thermosplat.config import LossConfig, TrainConfig
from thermosplat.training.train_frames import TrainFrames

_FROM_MEAN = math.sqrt(math.pi / 2.0)
"""Standard deviation over mean absolute value of a normal distribution."""
_VIEWS = 16
"""Most images that are looked at, spread over all."""


@dataclass(frozen=True)
class ThermalNoise:
    """Standard deviations of the noise of thermal images, of the range 0 to 1."""

    pixels: float
    """That differs from pixel to pixel."""
    stripes: float
    """Of rows and columns."""

    @property
    def total(self) -> float:
        """Of both together."""
        return math.hypot(self.pixels, self.stripes)


def image_noise(image: Tensor) -> ThermalNoise:
    """The noise of one image, mean over its channels.

    Args:
        image: [H, W, C] in 0 to 1, H and W at least 3.
    """
    across, down = image.diff(n=2, dim=1), image.diff(n=2, dim=0)
    response = across.diff(n=2, dim=0)
    stripes = math.hypot(_stripes(across, along=0), _stripes(down, along=1))
    return ThermalNoise(_FROM_MEAN * response.abs().mean().item() / 6.0, stripes)


def training_noise(frames: TrainFrames) -> ThermalNoise | None:
    """The median over training images; None where there are no thermal ones.

    Args:
        frames: The training frames.
    """
    having = [index for index, frame in enumerate(frames.frames) if frame.thermal is not None]
    chosen = having[:: math.ceil(len(having) / _VIEWS)] if having else []
    views = (frames[index].thermal for index in chosen)
    found = [image_noise(view.image) for view in views if view is not None and view.image is not None]
    if not found:
        return None
    return ThermalNoise(median(noise.pixels for noise in found), median(noise.stripes for noise in found))


def smoothness_for_noise(config: LossConfig, noise: float) -> float:
    """The weight of the thermal smoothness that this noise asks for.

    Args:
        config: The losses; ``thermal_smoothness_noise`` is more than 0.
        noise: Standard deviation, of the range 0 to 1.
    """
    share = min(noise / config.thermal_smoothness_noise, 1.0)
    least = min(config.thermal_smoothness_least, config.thermal_smoothness)
    return max(share * config.thermal_smoothness, least)


def with_measured_smoothness(config: TrainConfig, frames: TrainFrames) -> tuple[TrainConfig, tuple[str, ...]]:
    """The configuration with the thermal smoothness that the training images ask for, where it wants that measured.

    Args:
        config: The whole configuration.
        frames: The training frames.

    Returns:
        The configuration to train with, and what to tell the user about it.
    """
    loss = config.loss
    if loss.thermal_smoothness_noise == 0 or loss.thermal_smoothness == 0:
        return config, ()
    noise = training_noise(frames)
    if noise is None:
        return config, ()
    weight = smoothness_for_noise(loss, noise.total)
    note = (
        f"Thermal noise {noise.total:.4f} of the range (pixels {noise.pixels:.4f}, stripes {noise.stripes:.4f}): "
        f"smoothness weight {weight:.3f}."
    )
    return replace(config, loss=replace(loss, thermal_smoothness=weight)), (note,)


def _stripes(differences: Tensor, *, along: int) -> float:
    """σ of stripes along a dimension, of second differences across it."""
    length = differences.shape[along]
    middle = differences.sort(dim=along).values.narrow(along, length // 4, length - 2 * (length // 4))
    return _FROM_MEAN * middle.mean(dim=along).abs().mean().item() / math.sqrt(6.0)
