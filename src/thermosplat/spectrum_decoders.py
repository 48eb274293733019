"""A plain pixel-wise network for each spectrum, from the same rendered features: what MS-Splatting decodes with.

Stands where ``decoders.Decoders`` does: the same three methods, none of the connections between the spectra.
"""

import itertools
from typing import cast

import torch
from torch import Tensor, nn

from thermosplat.config import DecoderConfig
from thermosplat.decoders import Decoders


class SpectrumDecoders(nn.Module):
    """One network a spectrum: d -> hidden -> ... -> hidden -> channels, SiLU between the layers, a sigmoid at the end.

    Attributes:
        rgb_network: Decodes colours.
        thermal_network: Decodes the thermal image; None without thermal channels.

    Args:
        config: Widths.
        input_dim: Channels of a pixel's input, >= 1.
        thermal_channels: 3 for pseudo-coloured thermal images, 1 for normalised radiometric ones, 0 for none.
    """

    def __init__(self, config: DecoderConfig, input_dim: int, thermal_channels: int) -> None:
        super().__init__()
        self.rgb_network = _network(config, input_dim, 3)
        if config.hybrid_rgb:
            # As of Decoders: near black, so that the sum starts at the SH colour.
            nn.init.constant_(cast("nn.Linear", self.rgb_network[-1]).bias, config.rgb_head_bias)
        self.thermal_network = _network(config, input_dim, thermal_channels) if thermal_channels else None

    def rgb(self, visible_features: Tensor) -> Tensor:
        """The RGB image.

        Args:
            visible_features: Features rendered with the visible opacities, shape [H, W, d].

        Returns:
            Colours in (0, 1), shape [H, W, 3].
        """
        return torch.sigmoid(self.rgb_network(visible_features))

    def thermal(self, thermal_features: Tensor) -> Tensor:
        """The thermal image.

        Args:
            thermal_features: Features rendered with the thermal opacities, shape [H, W, d].

        Returns:
            Pseudo-colours or normalised intensities in (0, 1), shape [H, W, thermal channels].

        Raises:
            ValueError: If the decoders were made without thermal channels.
        """
        if self.thermal_network is None:
            raise ValueError("These decoders were made with thermal_channels=0; they have no thermal image.")
        return torch.sigmoid(self.thermal_network(thermal_features))

    def both(self, visible_features: Tensor, thermal_features: Tensor) -> tuple[Tensor, Tensor]:
        """``rgb`` and ``thermal`` of one frame.

        Args:
            visible_features: Features rendered with the visible opacities, shape [H, W, d].
            thermal_features: Features rendered with the thermal opacities, shape [H, W, d].

        Returns:
            Both images.

        Raises:
            ValueError: If the decoders were made without thermal channels.
        """
        return self.rgb(visible_features), self.thermal(thermal_features)


def make_decoders(config: DecoderConfig, feature_dim: int, thermal_channels: int) -> Decoders | SpectrumDecoders:
    """The decoders a configuration asks for.

    Args:
        config: Their structure and widths.
        feature_dim: Channels d of the rendered features.
        thermal_channels: 3 for pseudo-coloured thermal images, 1 for normalised radiometric ones, 0 for none.
    """
    input_dim = feature_dim + (3 if config.view_direction else 0)
    kind = SpectrumDecoders if config.branches == "separate" else Decoders
    return kind(config, input_dim, thermal_channels)


def _network(config: DecoderConfig, input_dim: int, output_dim: int) -> nn.Sequential:
    widths = [input_dim] + [config.hidden_dim] * config.hidden_layers
    layers: list[nn.Module] = []
    for width_in, width_out in itertools.pairwise(widths):
        layers += [nn.Linear(width_in, width_out), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], output_dim))
