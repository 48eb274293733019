"""The networks that turn blended features into images, pixel by pixel; a class for each ``DecoderConfig.branches``.

Notation of ``Decoders`` (ThermoSplat's spectrum-aware modulation), as in docs/method.md: A_f are features rendered with
a spectrum's opacities, h the shared encoding, h_p the prior of a spectrum p, (γ, β) the modulation.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from thermosplat.config import DecoderConfig
from thermosplat.spectra import Spectrum, first_photograph

Decode = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
"""``Decoder.decode``."""

HIDDEN_LAYERS = 2
"""Layers of the shared encoder, or of a spectrum's own network before the last, each followed by SiLU. Open choice:
ThermoSplat has "multiple pixel-wise linear layers", MS-Splatting one before a hidden layer and that."""
HYBRID_BIAS = -4.0
"""First bias of the layer whose image is added to SH colours, so that the sum starts at these: sigmoid(-4) = 0.018.
Open choice."""


class Decoder(nn.Module):
    """Networks of all spectra. Every layer acts on one pixel's channels, so any leading shape works."""

    def decode(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The decoded images of some spectra.

        Args:
            features: By spectrum what ``Formation.decoder_input`` makes of A_f, shape [H, W, d].

        Returns:
            Colours or intensities in (0, 1) by spectrum, shape [H, W, channels].
        """
        # One pass of all through layers that they share would copy the gradients of every hidden channel together.
        return {name: self.image(name, rendered) for name, rendered in features.items()}

    def image(self, spectrum: str, features: Tensor) -> Tensor:
        """The decoded image of one spectrum; arguments and result as of ``decode``.

        Raises:
            KeyError: The decoder was made without that spectrum.
        """
        raise NotImplementedError

    def start_at(self, spectrum: str, values: Tensor) -> None:
        """Let the decoded image of a spectrum begin near given values.

        Args:
            values: In (0, 1), by channel, shape [channels].
        """
        with torch.no_grad():
            self.last_layer(spectrum).bias.copy_(torch.logit(values))

    def last_layer(self, spectrum: str) -> nn.Linear:
        """The linear layer before a spectrum's sigmoid."""
        raise NotImplementedError


def with_fourier_features(features: Tensor, frequency: float) -> Tensor:
    """Features f with sin(ω f) and cos(ω f) behind them.

    Networks of few layers learn slowly what varies fast with their input; waves of it make that easy (Fourier features,
    Tancik et al. 2020). Neural Harmonic Textures (arXiv 2604.01204) do the same with what Gaussians blend.

    Args:
        features: A_f, shape [..., d].
        frequency: ω [radians per unit of a feature]; 0: features stay as they are.

    Returns:
        Shape [..., 3 d], or [..., d] where the frequency is 0.
    """
    if frequency == 0:
        return features
    angles = frequency * features
    return torch.cat([features, torch.sin(angles), torch.cos(angles)], dim=-1)


def num_inputs(feature_dim: int, frequency: float) -> int:
    """Channels of ``with_fourier_features``."""
    return feature_dim if frequency == 0 else 3 * feature_dim


PIXELS_AT_ONCE = 1 << 19
"""With 64 hidden channels a layer of so many takes 128 MiB."""


def decode_in_parts(decode: Decode, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The decoded images of some spectra, as ``decode`` gives them.

    Args:
        inputs: What they take by spectrum, at least one, all of shape [H, W, d].
    """
    height, width = next(iter(inputs.values())).shape[:2]
    rows = max(1, PIXELS_AT_ONCE // max(1, width))
    if torch.is_grad_enabled() or rows >= height:
        return decode(inputs)
    parts = [
        decode({name: values[top : top + rows] for name, values in inputs.items()}) for top in range(0, height, rows)
    ]
    return {name: torch.cat([part[name] for part in parts]) for name in inputs}


class Decoders(Decoder):
    """Shared encoder, and for every spectrum a prior or a modulation by another one's prior, and a head.

    Attributes:
        shared_encoder: Φ_shared, d -> hidden -> ... -> hidden, SiLU after every layer.
        priors: By spectrum, Φ_p, hidden -> hidden, SiLU. In ThermoSplat the thermal prior is the only one.
        modulations: By the spectrum that is modulated, Φ_mod, h_p -> [γ, β], linear; starts as the identity, γ = 1 and
            β = 0. Empty without modulation.
        heads: By spectrum, hidden -> channels, linear; a sigmoid follows.

    Args:
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

    def last_layer(self, spectrum: str) -> nn.Linear:
        """As of ``Decoder``."""
        return cast("nn.Linear", self.heads[spectrum])


def _identity_modulation(hidden: int) -> nn.Linear:
    """A linear map h_p -> [γ, β] whose output is γ = 1, β = 0 until it is trained."""
    layer = nn.Linear(hidden, 2 * hidden)
    nn.init.zeros_(layer.weight)
    with torch.no_grad():
        layer.bias[:hidden] = 1.0
        layer.bias[hidden:] = 0.0
    return layer


class SpectrumDecoders(Decoder):
    """A network per spectrum: d -> hidden -> ... -> hidden -> channels, SiLU between the layers, a sigmoid at the end.

    What MS-Splatting decodes with. Stands where ``Decoders`` does, with none of its connections between the spectra.

    Attributes:
        networks: By spectrum.

    Args:
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

    def last_layer(self, spectrum: str) -> nn.Linear:
        """As of ``Decoder``."""
        return cast("nn.Linear", cast("nn.Sequential", self.networks[spectrum])[-1])


def _network(config: DecoderConfig, input_dim: int, output_dim: int) -> nn.Sequential:
    widths = [input_dim] + [config.hidden_dim] * HIDDEN_LAYERS
    layers: list[nn.Module] = []
    for width_in, width_out in itertools.pairwise(widths):
        layers += [nn.Linear(width_in, width_out), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-1], output_dim))
