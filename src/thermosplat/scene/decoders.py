"""The pixel-wise networks between rendered features and images (ThermoSplat's spectrum-aware modulation).

Notation, as in docs/method.md: A_f are features rendered with a spectrum's opacities, h the shared encoding, h_p the
prior of a spectrum p, (γ, β) the modulation. Every layer is a linear map of one pixel's channels, with no spatial
context, so any leading shape works; [H, W, ...] is written for it.
"""

import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from thermosplat.config import DecoderConfig
from thermosplat.scene.decoder import HIDDEN_LAYERS, HYBRID_BIAS, Decoder
from thermosplat.spectra import Spectrum, first_photograph


class Decoders(Decoder):
    """Shared encoder, and for every spectrum a prior or a modulation by another one's prior, and a head.

    Attributes:
        shared_encoder: Φ_shared, d -> hidden -> ... -> hidden, SiLU after every layer.
        priors: By spectrum, Φ_p, hidden -> hidden, SiLU. In ThermoSplat the thermal prior is the only one.
        modulations: By the spectrum that is modulated, Φ_mod, h_p -> [γ, β], linear; starts as the identity, γ = 1 and
            β = 0. Empty without modulation.
        heads: By spectrum, hidden -> channels, linear; a sigmoid follows.

    Args:
        config: Widths and ablation switches.
        feature_dim: Channels d of the rendered features, >= 1.
        spectra: What is decoded, in order.
    """

    def __init__(self, config: DecoderConfig, feature_dim: int, spectra: Sequence[Spectrum]) -> None:
        super().__init__()
        hidden = config.hidden_dim
        widths = [feature_dim] + [hidden] * HIDDEN_LAYERS
        layers: list[nn.Module] = []
        for width_in, width_out in itertools.pairwise(widths):
            layers += [nn.Linear(width_in, width_out), nn.SiLU()]
        self.shared_encoder = nn.Sequential(*layers)
        self.priors = nn.ModuleDict()
        self.modulations = nn.ModuleDict()
        self.heads = nn.ModuleDict()
        self.modulated_by = {spectrum.name: spectrum.modulated_by for spectrum in spectra}
        for spectrum in spectra:
            prior = spectrum.modulated_by or spectrum.name
            if prior not in self.priors:
                self.priors[prior] = nn.Sequential(nn.Linear(hidden, hidden), nn.SiLU())
            if spectrum.modulated_by is not None and config.modulation:
                self.modulations[spectrum.name] = _identity_modulation(hidden)
            self.heads[spectrum.name] = head = nn.Linear(hidden, spectrum.channels)
            if spectrum.name == first_photograph(spectra):
                # With the hybrid sum the decoded part starts near black, so that the sum starts at the SH colour.
                nn.init.constant_(head.bias, HYBRID_BIAS if config.hybrid else 0.0)

    def image(self, spectrum: str, features: Tensor) -> Tensor:
        """As of ``Decoder``."""
        head, encoded = self.heads[spectrum], self.shared_encoder(features)
        prior = self.modulated_by[spectrum]
        if prior is None:
            encoded = self.priors[spectrum](encoded)
        elif spectrum in self.modulations:
            modulation, h_p = self.modulations[spectrum], self.priors[prior](encoded)
            # a product each in place of one cut in two, whose gradients would be copied together again
            (w_gamma, w_beta), (b_gamma, b_beta) = (p.chunk(2) for p in (modulation.weight, modulation.bias))  # type: ignore[operator]
            encoded = F.linear(h_p, w_gamma, b_gamma) * encoded + F.linear(h_p, w_beta, b_beta)
        return torch.sigmoid(head(encoded))


def _identity_modulation(hidden: int) -> nn.Linear:
    """A linear map h_p -> [γ, β] whose output is γ = 1, β = 0 until it is trained."""
    layer = nn.Linear(hidden, 2 * hidden)
    nn.init.zeros_(layer.weight)
    with torch.no_grad():
        layer.bias[:hidden] = 1.0
        layer.bias[hidden:] = 0.0
    return layer
