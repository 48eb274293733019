"""How noisy the images of a spectrum are, and what that means for their losses and for their camera's blur.

The noise of an image is estimated from the image alone (Immerkær 1996): the mask [1 -2 1]ᵀ [1 -2 1] leaves noise and
little of the scene, and a mean |response| r of Gaussian noise stands for σ = √(π/2) r / 6. It does not see what is
constant along a row or column, as the stripes of uncooled sensors are, so those are estimated by themselves: second
differences across the stripes, averaged along them without their outer quarters, which edges of the scene fill.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.spectra import SpectrumConfig, label
from thermosplat.training.frames.train_frames import TrainFrames

_FROM_MEAN = math.sqrt(math.pi / 2.0)
"""Standard deviation over mean absolute value of a normal distribution."""
_FROM_MEDIAN = 1.0 / 0.6744897501960817
"""Standard deviation over median absolute value of a normal distribution."""
_VIEWS = 16
"""Most images that are looked at, spread over all."""
NOISY = 0.033
"""Standard deviation where the scene is plain (``ImageNoise.plain``) from which on images count as noisy. Open choice:
photographs of desk, lab and yard have 0.038 to 0.044 at 140 electrons, 0.020 to 0.028 at 600
(benchmarks/records/low-light.md)."""


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


NoiseOf = Callable[[str], ImageNoise | None]
"""The noise of a spectrum's training images, as ``training_noise`` measures it."""


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
    """The median over training images of a spectrum; None where there are none.

    Args:
        frames: The training frames.
        spectrum: Which spectrum.
    """
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


def smoothness_for_noise(spectrum: SpectrumConfig, noise: float) -> float:
    """The weight of a spectrum's smoothness that this noise asks for.

    Args:
        spectrum: Its settings; ``smoothness_noise`` is more than 0.
        noise: Standard deviation, of the range 0 to 1.
    """
    share = min(noise / spectrum.smoothness_noise, 1.0)
    least = min(spectrum.smoothness_least, spectrum.smoothness)
    return max(share * spectrum.smoothness, least)


def loss_for_noise(spectrum: SpectrumConfig, noise: float) -> float:
    """The weight of a spectrum's image loss that this noise asks for: images of much noise count no more than once.

    Args:
        spectrum: Its settings; ``loss_noise`` is more than 0.
        noise: Standard deviation, of the range 0 to 1.
    """
    share = min(noise / spectrum.loss_noise, 1.0)
    return spectrum.loss - share * max(spectrum.loss - 1.0, 0.0)


def noisy_spectra(config: TrainConfig, noise_of: NoiseOf) -> tuple[str, ...]:
    """The spectra whose images count as noisy: with ``--budget auto``, from ``NOISY`` on.

    Args:
        config: The whole configuration.
        noise_of: The noise of a spectrum's training images.
    """
    if config.budget != "auto":
        return ()
    return tuple(name for name in config.modelled if (noise := noise_of(name)) is not None and noise.plain >= NOISY)


def fitted_to_noise(config: TrainConfig, noise_of: NoiseOf) -> tuple[TrainConfig, tuple[str, ...]]:
    """The configuration with the weights and point spreads that the noise of the training images allows.

    Args:
        config: The whole configuration.
        noise_of: The noise of a spectrum's training images.

    Returns:
        The configuration to train with, and what to tell the user about it.
    """
    spectra, notes = dict(config.spectra), []
    for name, spectrum in config.modelled.items():
        weighs = spectrum.loss_noise > 0 and spectrum.loss > 1
        smooths = spectrum.smoothness_noise > 0 and spectrum.smoothness > 0
        blurs = spectrum.point_spread_noise > 0 and spectrum.point_spread > 0
        if not (weighs or smooths or blurs) or (noise := noise_of(name)) is None:
            continue
        said = []
        if weighs:
            spectrum = replace(spectrum, loss=loss_for_noise(spectrum, noise.total))
            said.append(f"loss weight {spectrum.loss:.3f}")
        if smooths:
            spectrum = replace(spectrum, smoothness=smoothness_for_noise(spectrum, noise.total))
            said.append(f"smoothness weight {spectrum.smoothness:.3f}")
        if blurs and noise.total >= spectrum.point_spread_noise:
            spectrum = replace(spectrum, point_spread=0.0)
            said.append("no point spread")
        if not said:
            continue
        spectra[name] = spectrum
        notes.append(
            f"Noise of the {label(name)} images {noise.total:.4f} of the range (pixels {noise.pixels:.4f}, stripes "
            f"{noise.stripes:.4f}): {', '.join(said)}."
        )
    return replace(config, spectra=spectra), tuple(notes)


def _whole_neighbourhoods(mask: Tensor) -> Tensor:
    """Where the 3x3 pixels of a response all count, bool [H - 2, W - 2]."""
    return mask.unfold(0, 3, 1).unfold(1, 3, 1).flatten(2).all(dim=-1)


def _stripes(differences: Tensor, *, along: int) -> float:
    """σ of stripes along a dimension, of second differences across it."""
    length = differences.shape[along]
    middle = differences.sort(dim=along).values.narrow(along, length // 4, length - 2 * (length // 4))
    return _FROM_MEAN * middle.mean(dim=along).abs().mean().item() / math.sqrt(6.0)
