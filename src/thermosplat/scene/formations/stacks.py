"""Stacks of channels: feature maps (Feature 3DGS, Zhou et al. 2024), and bands of hyperspectral cameras (HyperGS).

Training images are coordinates in a basis, and the length of what it leaves out (``datasets.images.stack_images``). The
network makes coordinates of what is blended. Errors of all channels come of these, however many there are.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from thermosplat.config import LossConfig, ModelConfig
from thermosplat.config.band_formulas import parsed
from thermosplat.errors import UserError
from thermosplat.fused.image_loss import ImageTerm
from thermosplat.scene.formations.formation import Blended, Common, LossTerm
from thermosplat.scene.formations.own_network import NetworkFormation
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import LATENT, STACKS, Spectrum, SpectrumConfig
from thermosplat.thermal.radiometry import PixelScale

if TYPE_CHECKING:
    from thermosplat.datasets.capture import View
    from thermosplat.datasets.frame_tensors import ViewTensors

QUERY = "query"
"""Layer: how well pixels' features fit a direction."""
_LEAST = 1e-6
"""Squared length below which nothing is divided by it, and below which a pixel's error counts as none."""


class StackFormation(NetworkFormation):
    """The image is coordinates c as (c + 1) / 2, and 0 for what they leave out.

    Attributes:
        basis: Orthonormal rows, [LATENT, channels].
        query: What features are compared with, [channels]; zeros: nothing.
    """

    basis: Tensor
    query: Tensor

    def __init__(self, spectrum: Spectrum, common: Common) -> None:
        super().__init__(spectrum, common, LATENT)
        settings = spectrum.settings
        self.register_buffer("basis", torch.zeros(LATENT, settings.channels))
        self.register_buffer("query", torch.zeros(settings.channels), persistent=False)
        self.formulas = {
            one.name: one for text in settings.derived for one in [parsed(text, settings.channels, "derived")]
        }
        self.layers = tuple(self.formulas)

    @classmethod
    def is_for(cls, spectrum: Spectrum, model: ModelConfig) -> bool:
        """As of ``Formation``: its files have any number of channels."""
        return spectrum.settings.source in STACKS

    @property
    def are_directions(self) -> bool:
        """Whether lengths do not count."""
        return self.spectrum.settings.source == "features"

    def begin(self, scale: PixelScale, views: "Sequence[View]") -> None:
        """As of ``Formation``: the basis of the capture's files."""
        if scale.basis is not None:
            self.basis.copy_(torch.from_numpy(scale.basis))

    def basis_of_images(self) -> Tensor:
        """As of ``Formation``."""
        return self.basis

    def ask(self, query: Tensor) -> bool:
        """As of ``Formation``: ``QUERY`` is a layer from now on, of features."""
        if not self.are_directions:
            return False
        if query.shape != self.query.shape or not query.isfinite().all() or not query.any():
            raise UserError(
                f"The query has the shape {list(query.shape)}; {self.name} is asked by {self.query.numel()} finite "
                "numbers that are not all zero.",
                "Save it by numpy.save, made by the model that made the feature maps.",
            )
        self.query.copy_(query)
        self.layers = (QUERY, *self.formulas)
        return True

    def render(self, blended: Blended, decoded: Tensor | None) -> Tensor:
        """As of ``Formation``."""
        made = blended.alpha * self.made_of(blended.features)
        return F.pad((made + 1) / 2, (0, 1))

    def losses(
        self, rendered: RenderedFrame, view: "ViewTensors", settings: SpectrumConfig, weights: LossConfig
    ) -> list[ImageTerm | LossTerm]:
        """As of ``Formation``: 1 - cosine of features; of bands the root of a pixel's mean squared error."""
        image = rendered.images.get(self.name)
        if settings.loss == 0 or image is None or view.image is None:
            return []
        if self.are_directions:
            errors = 1 - cosines(image, view.image)
        else:
            errors = (squared_errors(image, view.image) + _LEAST).sqrt()
        return [LossTerm(self.name, settings.loss * _mean(errors, view.mask))]

    def image_of(self, gaussians: Gaussians) -> Tensor:
        """As of ``Formation``: of its own features."""
        return F.pad((self.of_each(gaussians) + 1) / 2, (0, 1))

    def graded(self, rendered: RenderedFrame) -> Tensor:
        """As of ``Formation``: the coordinates, of features their direction; what a basis leaves out is not shown."""
        return self.graded_truth(rendered.images[self.name])

    def graded_truth(self, image: Tensor) -> Tensor:
        """As of ``Formation``."""
        coordinates = _coordinates(image)
        return ((F.normalize(coordinates, dim=-1) if self.are_directions else coordinates) + 1) / 2

    def scores(self, image: Tensor, target: Tensor, mask: Tensor | None) -> Mapping[str, float]:
        """As of ``Formation``: the mean cosine of features, or the PSNR of all bands [dB]."""
        if self.are_directions:
            return {"cosine": _mean(cosines(image, target), mask).item()}
        return {"psnr_bands": -10 * _mean(squared_errors(image, target), mask).clamp(min=1e-12).log10().item()}

    def layer(self, layer: str, rendered: RenderedFrame) -> Tensor:
        """As of ``Formation``: the cosine of a pixel's features and the query, or a formula of bands."""
        coordinates = _coordinates(rendered.images[self.name])
        if layer == QUERY:
            asked = F.normalize(self.query, dim=0)
            return F.normalize(coordinates, dim=-1) @ (self.basis @ asked)
        scale = self.basis.shape[1] ** 0.5

        @functools.cache
        def band(place: int) -> Tensor:
            return scale * (coordinates @ self.basis[:, place])

        return torch.as_tensor(self.formulas[layer].value(band)).nan_to_num().expand(coordinates.shape[:2])

    def layer_range(self, layer: str) -> tuple[float, float]:
        """As of ``Formation``: that of indices, -1 to 1."""
        return (0.0, 1.0) if layer == QUERY else (-1.0, 1.0)


def squared_errors(image: Tensor, target: Tensor) -> Tensor:
    """Mean over all bands of the squared error of each pixel, [H, W].

    Args:
        image: As ``StackFormation`` renders it, [H, W, LATENT + 1].
        target: As its training images are.
    """
    apart = 2 * (image[..., :-1] - target[..., :-1])
    return apart.square().sum(dim=-1) + target[..., -1].square()


def cosines(image: Tensor, target: Tensor) -> Tensor:
    """Cosine of each pixel's features and the true ones, over all channels, [H, W].

    The arguments are those of ``squared_errors``.
    """
    found, true = _coordinates(image), _coordinates(target)
    lengths = found.square().sum(dim=-1) * (true.square().sum(dim=-1) + target[..., -1].square())
    return (found * true).sum(dim=-1) * lengths.clamp(min=_LEAST).rsqrt()


def _coordinates(image: Tensor) -> Tensor:
    """What an image [H, W, LATENT + 1] says of each pixel's coordinates, [H, W, LATENT]."""
    return 2 * image[..., :-1] - 1


def _mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of values [H, W] of the pixels that count."""
    return values.mean() if mask is None else torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)
