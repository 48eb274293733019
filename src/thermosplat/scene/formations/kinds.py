"""Kinds of formations, and of decoders: which class serves which configuration. A new one has a line here."""

from collections.abc import Sequence

from thermosplat.config import DecoderConfig, ModelConfig
from thermosplat.scene.decoder import Decoder, Decoders, SpectrumDecoders, num_inputs
from thermosplat.scene.formations.decoded import DecodedFormation
from thermosplat.scene.formations.formation import Formation
from thermosplat.scene.formations.harmonic import HarmonicFormation
from thermosplat.scene.formations.labels import LabelFormation
from thermosplat.scene.formations.stacks import StackFormation
from thermosplat.spectra import Spectrum

FORMATIONS: list[type[Formation]] = [LabelFormation, StackFormation, DecodedFormation, HarmonicFormation]
"""A spectrum has the first that is for it; those that are for few spectra come before those that are for many."""

DECODERS: dict[str, type[Decoder]] = {"joined": Decoders, "separate": SpectrumDecoders}
"""By ``DecoderConfig.branches``. Each is made with the configuration, the channels of its input and the spectra."""


def make_decoder(config: DecoderConfig, feature_dim: int, spectra: Sequence[Spectrum]) -> Decoder:
    """The decoder that a configuration asks for.

    Args:
        feature_dim: Channels d of the rendered features.
    """
    inputs = num_inputs(feature_dim, config.fourier_frequency) + (3 if config.view_direction else 0)
    return DECODERS[config.branches](config, inputs, spectra)


def kind_of(spectrum: Spectrum, model: ModelConfig) -> type[Formation]:
    """The kind of a spectrum's formation."""
    return next(kind for kind in FORMATIONS if kind.is_for(spectrum, model))
