"""Images that networks decode of blended features, pixel by pixel: ThermoSplat's (docs/method.md, equations 3 to 8)."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from thermosplat.config import ModelConfig
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.fused.covered_images import warp_covered
from thermosplat.scene.decoder import with_fourier_features
from thermosplat.scene.formations.formation import Blended, Common, Formation
from thermosplat.scene.gaussians import SH_C0, Gaussians
from thermosplat.scene.point_spread import PointSpread
from thermosplat.scene.view_directions import view_directions
from thermosplat.spectra import Spectrum
from thermosplat.thermal.radiometry import PixelScale

if TYPE_CHECKING:
    from thermosplat.datasets.capture import View

EDGE = 0.05
"""Mean values nearer to an end of the range are far from grey. Thermal images of the captures here have means of 0.10
to 0.49; with a lamp that stretches their range 0.01. Open choice."""
START = 0.1
"""A decoder of such images starts this far from that end of the range; nearer to it, sigmoid has less slope. Open
choice, measured beside 0.01 and grey in benchmarks/records/real-captures.md#situations."""
LOOKED_AT = 16
"""Images of which the mean is taken, at most."""


class DecodedFormation(Formation):
    """The image is decoded of the features that are blended at the spectrum's opacity.

    Of the photograph that comes first, SH colours are blended, too; with ``decoder.hybrid`` the image is the sum.

    Attributes:
        settings: What the decoder sees, and what becomes of what it makes.
        point_spread: How the spectrum's camera blurs what it sees, before that is decoded; None: not at all.
        is_sum: The image is the sum of SH colours and the decoded part.
    """

    takes_features = True
    decodes = True

    def __init__(self, spectrum: Spectrum, common: Common) -> None:
        super().__init__(spectrum, common)
        self.settings = common.decoding
        width = spectrum.settings.point_spread
        self.point_spread = PointSpread(width) if width > 0 else None
        self.takes_colors = spectrum.name == common.photograph
        self.is_sum = self.takes_colors and self.settings.hybrid

    @classmethod
    def is_for(cls, spectrum: Spectrum, model: ModelConfig) -> bool:
        """As of ``Formation``: there are features."""
        return model.feature_dim > 0

    def begin(self, scale: PixelScale, views: "Sequence[View]") -> None:
        """As of ``Formation``: where images lie at an end of their range, the decoder starts near that end.

        One that starts grey darkens all pixels first, and may go on to where sigmoid has no slope: the image then stays
        black (benchmarks/records/real-captures.md#situations).
        """
        if self.is_sum or self.common.decoder is None or not views:
            return
        seen = (view_tensors(view, None, "cpu").image for view in views[:: -(-len(views) // LOOKED_AT)])
        mean = torch.stack([self._there(image).mean(dim=(0, 1)) for image in seen]).mean(dim=0)
        if bool(((mean < EDGE) | (mean > 1.0 - EDGE)).all()):
            padding = self.settings.padding
            self.common.decoder.start_at(self.name, (mean.clamp(START, 1.0 - START) + padding) / (1.0 + 2.0 * padding))

    def through_optics(self, blended: Blended) -> Blended:
        """As of ``Formation``: blurred, unless it is a map, which no camera takes."""
        spread, view = self.point_spread, blended.view
        if spread is None or view is None or view.orthographic:
            return blended
        features = None if blended.features is None else spread(blended.features)
        colors = None if blended.colors is None else spread(blended.colors)
        return dataclasses.replace(blended, features=features, colors=colors)

    def decoder_input(self, features: Tensor | None, view: ViewTensors | None) -> Tensor | None:
        """As of ``Formation``: features, waves of them and viewing directions, as ``decoder`` asks for."""
        if features is None:
            return None
        inputs = with_fourier_features(features, self.settings.fourier_frequency)
        if not self.settings.view_direction:
            return inputs
        if view is None:
            return torch.nn.functional.pad(inputs, (0, 3))  # no direction
        return torch.cat([inputs, view_directions(view)], dim=-1)

    def render(self, blended: Blended, decoded: Tensor | None) -> Tensor:
        """As of ``Formation``: what is decoded, as far as Gaussians cover it, added to SH colours or black."""
        decoded = self._there(decoded)
        if self.is_sum:
            return self._covered(decoded, blended.alpha, blended.colors)
        padding = self.settings.padding  # Mip-NeRF's; the sum has no range to widen
        image = decoded if padding == 0 else (1.0 + 2.0 * padding) * decoded - padding
        base = None
        if self.takes_colors and blended.background is not None:
            base = (1.0 - blended.alpha) * blended.background
        return self._covered(image, blended.alpha, base)

    def _covered(self, decoded: Tensor, alpha: Tensor, base: Tensor | None) -> Tensor:
        """A decoded image as far as Gaussians cover it, added to ``base``, or black, the lowest value.

        So the background shows where no Gaussian is, as in 3DGS: there the networks' answer to zero features is one
        that nothing has taught them. Open choice.
        """
        if decoded.is_cuda:
            return warp_covered(decoded, alpha, base)
        covered = alpha * decoded
        return covered if base is None else base + covered

    def _there(self, decoded: Tensor | None) -> Tensor:
        if decoded is None:
            raise ValueError(f"{self.name} is decoded of features, and there are none.")
        return decoded

    def pixels_of_features(self, features: Tensor, alpha: Tensor, view: ViewTensors, every: int) -> Tensor:
        """As of ``Formation``: the decoded part, before its range is widened."""
        inputs, decoder = self._there(self.decoder_input(features, view)), self.common.decoder
        decoded = self._there(None if decoder is None else decoder.image(self.name, inputs.flatten(0, 1)[::every]))
        return decoded * alpha.detach().flatten()[::every, None]

    def image_of(self, gaussians: Gaussians) -> Tensor:
        """As of ``Formation``: its own features decoded as if they alone filled a pixel, A_f = f."""
        decoded = self._there(self.decoded(gaussians.expanded(gaussians.features)))
        return 0.5 + SH_C0 * gaussians.sh0[:, 0] + decoded if self.is_sum else decoded

    def harmonics(self, gaussians: Gaussians, shown: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """As of ``Formation``: of a sum the Gaussians' own with the decoded part, else one colour from everywhere."""
        if not self.is_sum:
            return super().harmonics(gaussians, shown)
        decoded = self._there(self.decoded(gaussians.expanded(gaussians.features)))
        return gaussians.sh0 + decoded[:, None] / SH_C0, gaussians.shN

    def numbers(self) -> Mapping[str, float]:
        """As of ``Formation``: the blur's standard deviation [of an image's width]."""
        return {} if self.point_spread is None else {"point_spread": self.point_spread.width}
