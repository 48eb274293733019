"""Formations with a network of their own between what is blended of Gaussians and what it means.

Where Gaussians have features, they are the scene's: they learn of this spectrum, too. Without, it has SH colours of its
own, which stand for no colour, as MMOne's embeddings do.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

from torch import Tensor, nn

from thermosplat.scene.decoder import decode_in_parts
from thermosplat.scene.formations.formation import Blended, Common, Formation
from thermosplat.scene.gaussians import SH_C0, Gaussians, PointColors, sh_names
from thermosplat.spectra import Spectrum

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


class NetworkFormation(Formation):
    """What is blended goes through a network, pixel by pixel.

    Attributes:
        network: d -> hidden -> outputs, SiLU between.

    Args:
        spectrum: As of ``Formation``.
        common: As of ``Formation``.
        outputs: Channels of what the network makes.
    """

    def __init__(self, spectrum: Spectrum, common: Common, outputs: int) -> None:
        super().__init__(spectrum, common)
        self.takes_features = common.model.feature_dim > 0
        self.takes_colors = not self.takes_features
        inputs, hidden = common.model.feature_dim or 3, common.decoding.hidden_dim
        self.network = nn.Sequential(nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, outputs))

    def initial(self, points: PointColors, *, is_first: bool) -> dict[str, Tensor]:
        """As of ``Formation``: SH colours where there are no features."""
        if is_first or self.takes_features:
            return {}
        return dict(zip(sh_names(self.name), points.harmonics(self.spectrum), strict=True))

    def through_optics(self, blended: Blended) -> Blended:
        """As of ``Formation``: what the network takes are features, wherever it comes from."""
        return blended if self.takes_features else dataclasses.replace(blended, features=blended.colors)

    def made_of(self, features: Tensor | None) -> Tensor:
        """What the network makes of features [H, W, d], some rows at a time where nothing is learnt.

        Raises:
            ValueError: Nothing was blended.
        """
        if features is None:
            raise ValueError(f"{self.name} takes features or SH colours, and none were blended.")
        return decode_in_parts(self._decode, {self.name: features})[self.name]

    def pixels_of_features(self, features: Tensor, alpha: Tensor, view: "ViewTensors", every: int) -> Tensor:
        """As of ``Formation``: what the network makes of them."""
        return self.network(features.flatten(0, 1)[::every])

    def of_each(self, gaussians: Gaussians) -> Tensor:
        """What the network makes of each Gaussian alone, [N, outputs]."""
        if self.takes_features:
            return self.network(gaussians.expanded(gaussians.features))
        return self.network(0.5 + SH_C0 * gaussians.sh_coeffs_of(self.name)[0][:, 0])

    def _decode(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: self.network(values) for name, values in features.items()}
