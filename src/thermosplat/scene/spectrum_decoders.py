"""A plain pixel-wise network per spectrum, from the same rendered features: what MS-Splatting decodes with.

Stands where ``decoders.Decoders`` does: the same methods, none of the connections between the spectra.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from thermosplat.config import DecoderConfig
from thermosplat.scene.decoders import HIDDEN_LAYERS, HYBRID_BIAS, Decoders, may_be_hybrid
from thermosplat.scene.fourier_features import num_inputs
from thermosplat.scene.point_spread import PointSpreads
from thermosplat.spectra import Spectrum


class SpectrumDecoders(nn.Module):
    """A network per spectrum: d -> hidden -> ... -> hidden -> channels, SiLU between the layers, a sigmoid at the end.

    Attributes:
        networks: By spectrum.
        point_spreads: As of ``Decoders``.

    Args:
        config: Widths.
        input_dim: Channels of a pixel's input, >= 1.
        spectra: What is decoded, in order.
    """

    def __init__(self, config: DecoderConfig, input_dim: int, spectra: Sequence[Spectrum]) -> None:
        super().__init__()
        self.networks = nn.ModuleDict()
        self.point_spreads = PointSpreads(spectra)
        for spectrum in spectra:
            self.networks[spectrum.name] = network = _network(config, input_dim, spectrum.channels)
            if config.hybrid and may_be_hybrid(spectrum, spectra):
                # As of Decoders: near black, so that the sum starts at the SH colour.
                nn.init.constant_(cast("nn.Linear", network[-1]).bias, HYBRID_BIAS)

    def decode(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The decoded images of some spectra.

        Args:
            features: A_f by spectrum, shape [H, W, d].

        Returns:
            Colours or intensities in (0, 1) by spectrum, shape [H, W, channels].
        """
        return {name: self.image(name, rendered) for name, rendered in features.items()}

    def image(self, spectrum: str, features: Tensor) -> Tensor:
        """The decoded image of one spectrum; arguments and result as of ``decode``.

        Raises:
            KeyError: The decoders were made without that spectrum.
        """
        return torch.sigmoid(self.networks[spectrum](features))


def make_decoders(config: DecoderConfig, feature_dim: int, spectra: Sequence[Spectrum]) -> Decoders | SpectrumDecoders:
    """The decoders a configuration asks for.

    Args:
        config: Their structure and widths.
        feature_dim: Channels d of the rendered features.
        spectra: What is decoded, in order.
    """
    input_dim = num_inputs(feature_dim, config.fourier_frequency) + (3 if config.view_direction else 0)
    kind = SpectrumDecoders if config.branches == "separate" else Decoders
    return kind(config, input_dim, spectra)


def _network(config: DecoderConfig, input_dim: int, output_dim: int) -> nn.Sequential:
    widths = [input_dim] + [config.hidden_dim] * HIDDEN_LAYERS
    layers: list[nn.Module] = []
    for width_in, width_out in itertools.pairwise(widths):
        layers += [nn.Linear(width_in, width_out), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], output_dim))
