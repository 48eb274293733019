"""The pixel-wise networks between rendered features and images (ThermoSplat's spectrum-aware modulation).

Notation, as in docs/method.md: A_f and A_ft are features rendered with the visible and the thermal opacities, h the
shared encoding, h_th the thermal prior, (γ, β) the modulation. Every layer is a linear map of one pixel's channels,
with no spatial context, so any leading shape works; [H, W, ...] is written for it.
"""

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from thermosplat.config import DecoderConfig


class Decoders(nn.Module):
    """Shared encoder, thermal prior head, modulation, and the heads of both images.

    Attributes:
        shared_encoder: Φ_shared, d -> hidden -> ... -> hidden, SiLU after every layer.
        thermal_prior: Φ_th, hidden -> hidden, SiLU.
        modulation: Φ_mod, h_th -> [γ, β], linear; starts as the identity, γ = 1 and β = 0. None without modulation.
        rgb_head: Φ_rgb, hidden -> 3, linear; a sigmoid follows.
        thermal_head: Φ_th_out, hidden -> thermal channels, linear; a sigmoid follows. None without thermal channels.

    Args:
        config: Widths and ablation switches.
        feature_dim: Channels d of the rendered features, >= 1.
        thermal_channels: 3 for pseudo-coloured thermal images, 1 for normalised radiometric ones, 0 for none.
    """

    def __init__(self, config: DecoderConfig, feature_dim: int, thermal_channels: int) -> None:
        super().__init__()
        hidden = config.hidden_dim
        widths = [feature_dim] + [hidden] * config.hidden_layers
        layers: list[nn.Module] = []
        for width_in, width_out in itertools.pairwise(widths):
            layers += [nn.Linear(width_in, width_out), nn.SiLU()]
        self.shared_encoder = nn.Sequential(*layers)
        self.thermal_prior = nn.Sequential(nn.Linear(hidden, hidden), nn.SiLU())
        self.modulation = _identity_modulation(hidden) if config.modulation else None
        self.rgb_head = nn.Linear(hidden, 3)
        # With the hybrid sum the decoded part starts near black, so that the sum starts at the SH colour.
        nn.init.constant_(self.rgb_head.bias, config.rgb_head_bias if config.hybrid_rgb else 0.0)
        self.thermal_head = nn.Linear(hidden, thermal_channels) if thermal_channels else None

    def rgb(self, visible_features: Tensor) -> Tensor:
        """The decoded part of the RGB image, C_impl.

        Args:
            visible_features: A_f, shape [H, W, d].

        Returns:
            Colours in (0, 1), shape [H, W, 3].
        """
        encoded = self.shared_encoder(visible_features)
        if self.modulation is not None:
            prior = self.thermal_prior(encoded)
            # a product each in place of one cut in two, whose gradients would be copied together again
            (w_gamma, w_beta), (b_gamma, b_beta) = (p.chunk(2) for p in (self.modulation.weight, self.modulation.bias))
            encoded = F.linear(prior, w_gamma, b_gamma) * encoded + F.linear(prior, w_beta, b_beta)
        return torch.sigmoid(self.rgb_head(encoded))

    def thermal(self, thermal_features: Tensor) -> Tensor:
        """The thermal image, C_th.

        Args:
            thermal_features: A_ft, shape [H, W, d].

        Returns:
            Pseudo-colours or normalised intensities in (0, 1), shape [H, W, thermal channels].

        Raises:
            ValueError: If the decoders were made without thermal channels.
        """
        if self.thermal_head is None:
            raise ValueError("These decoders were made with thermal_channels=0; they have no thermal image.")
        return torch.sigmoid(self.thermal_head(self.thermal_prior(self.shared_encoder(thermal_features))))

    def both(self, visible_features: Tensor, thermal_features: Tensor) -> tuple[Tensor, Tensor]:
        """``rgb`` and ``thermal`` of one frame.

        Args:
            visible_features: A_f, shape [H, W, d].
            thermal_features: A_ft, shape [H, W, d].

        Returns:
            C_impl and C_th.

        Raises:
            ValueError: If the decoders were made without thermal channels.
        """
        # One pass of both through the layers they share would copy the gradients of every hidden channel together.
        return self.rgb(visible_features), self.thermal(thermal_features)


def _identity_modulation(hidden: int) -> nn.Linear:
    """A linear map h_th -> [γ, β] whose output is γ = 1, β = 0 until it is trained."""
    layer = nn.Linear(hidden, 2 * hidden)
    nn.init.zeros_(layer.weight)
    with torch.no_grad():
        layer.bias[:hidden] = 1.0
        layer.bias[hidden:] = 0.0
    return layer
