"""What the training images of a spectrum say of its sensor, and what a training does about it: the one policy.

The fact is the noise of the images (image_noise.py). It decides what else can be known of a sensor: noise rewards blur,
so that no blur is learnt where it is large. What drifts from image to image is learnt with the scene (exposures.py).
Noise is small or large beside what most values span, not beside a range that one hot corner makes wide, and not in
kelvin: 0.3 K hide a wall's 2 K and nothing of a furnace's 500 K.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

from thermosplat.config import TrainConfig
from thermosplat.spectra import NOISY_SENSOR, SpectrumConfig, label
from thermosplat.training.image_noise import ImageNoise

NOISY_IMAGES = 0.033
"""Standard deviation where the scene is plain (``ImageNoise.plain``) from which on the images of any sensor count as
noisy. Open choice: photographs of desk, lab and yard have 0.038 to 0.044 at 140 electrons, 0.020 to 0.028 at 600
(benchmarks/records/low-light.md)."""
LEAST_SMOOTHNESS = 0.05
"""Weight of the smoothness of images without noise, where noise decides. Open choice."""


class SensorFacts:
    """The facts of a training's spectra, each measured when it is first asked for.

    Args:
        measure: The noise of a spectrum's training images; None where it has none.
        noisy: The spectra whose images counted as noisy when the run began. None: the run begins.
        widths: How many times as wide as what most of a spectrum's values span its range is, at least 1.
    """

    def __init__(
        self,
        config: TrainConfig,
        measure: Callable[[str], ImageNoise | None],
        noisy: tuple[str, ...] | None = None,
        widths: Callable[[str], float] = lambda spectrum: 1.0,
    ) -> None:
        self.noise = cache(measure)
        """The noise of a spectrum's training images."""
        self._widths = cache(widths)
        self.noisy = self._noisy(config) if noisy is None else noisy
        """The spectra whose images count as noisy, with ``--budget auto``."""

    def _noisy(self, config: TrainConfig) -> tuple[str, ...]:
        if config.budget != "auto":
            return ()
        return tuple(
            name
            for name in config.modelled
            if (noise := self.noise(name)) is not None and noise.plain * self._widths(name) >= NOISY_IMAGES
        )

    def fitted(self, config: TrainConfig, *, blur_is_known: bool = False) -> tuple[TrainConfig, tuple[str, ...]]:
        """The configuration with the weights and point spreads that the sensors allow.

        Args:
            blur_is_known: Leave point spreads alone: noise has decided of them already.

        Returns:
            The configuration to train with, and what to tell the user about it.
        """
        spectra, notes = dict(config.spectra), []
        for name, asked in config.modelled.items():
            counts = asked.by_noise and (asked.loss > 1 or asked.smoothness > 0 or asked.point_spread > 0)
            if not counts or (noise := self.noise(name)) is None:
                continue
            width = self._widths(name)
            spectra[name], said = by_noise(asked, width * noise.total, blur_is_known=blur_is_known)
            if said:
                wide = f", which is {width:.1f} times as wide as what most values span" if width > 1 else ""
                notes.append(
                    f"Noise of the {label(name)} images {noise.total:.4f} of the range{wide} (pixels "
                    f"{noise.pixels:.4f}, stripes {noise.stripes:.4f}): {', '.join(said)}."
                )
        return replace(config, spectra=spectra), tuple(notes)


def by_noise(
    spectrum: SpectrumConfig, noise: float, *, blur_is_known: bool = False
) -> tuple[SpectrumConfig, list[str]]:
    """A spectrum's settings for a sensor of some noise, and what differs.

    From no noise to that of a noisy sensor, a weight of the loss above 1 falls to 1, and the weight of the smoothness
    rises to what is asked for. Images of a noisy sensor have no point spread.

    Args:
        spectrum: The settings, which noise decides.
        noise: Standard deviation, of what most values span.
    """
    share, said = min(noise / NOISY_SENSOR, 1.0), []
    if spectrum.loss > 1:
        spectrum = replace(spectrum, loss=spectrum.loss - share * (spectrum.loss - 1.0))
        said.append(f"loss weight {spectrum.loss:.3f}")
    if spectrum.smoothness > 0:
        least = min(LEAST_SMOOTHNESS, spectrum.smoothness)
        spectrum = replace(spectrum, smoothness=max(share * spectrum.smoothness, least))
        said.append(f"smoothness weight {spectrum.smoothness:.3f}")
    if spectrum.point_spread > 0 and share == 1.0 and not blur_is_known:
        spectrum = replace(spectrum, point_spread=0.0)
        said.append("no point spread")
    return spectrum, said
