"""A plain pixel-wise network per spectrum, from the same rendered features: what MS-Splatting decodes with.

Stands where ``decoders.Decoders`` does, with none of its connections between the spectra.
"""

import itertools
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from thermosplat.config import DecoderConfig
from thermosplat.scene.decoder import HIDDEN_LAYERS, HYBRID_BIAS, Decoder
from thermosplat.spectra import Spectrum, first_photograph


class SpectrumDecoders(Decoder):
    """A network per spectrum: d -> hidden -> ... -> hidden -> channels, SiLU between the layers, a sigmoid at the end.

    Attributes:
        networks: By spectrum.

    Args:
        config: Widths.
        input_dim: Channels of a pixel's input, >= 1.
        spectra: What is decoded, in order.
    """

    def __init__(self, config: DecoderConfig, input_dim: int, spectra: Sequence[Spectrum]) -> None:
        super().__init__()
        self.networks = nn.ModuleDict()
        for spectrum in spectra:
            self.networks[spectrum.name] = network = _network(config, input_dim, spectrum.channels)
            if config.hybrid and spectrum.name == first_photograph(spectra):
                # As of Decoders: near black, so that the sum starts at the SH colour.
                nn.init.constant_(cast("nn.Linear", network[-1]).bias, HYBRID_BIAS)

    def image(self, spectrum: str, features: Tensor) -> Tensor:
        """As of ``Decoder``."""
        return torch.sigmoid(self.networks[spectrum](features))


def _network(config: DecoderConfig, input_dim: int, output_dim: int) -> nn.Sequential:
    widths = [input_dim] + [config.hidden_dim] * HIDDEN_LAYERS
    layers: list[nn.Module] = []
    for width_in, width_out in itertools.pairwise(widths):
        layers += [nn.Linear(width_in, width_out), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], output_dim))
