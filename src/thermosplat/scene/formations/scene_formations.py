"""How all images of a scene are formed: a formation for each spectrum, and the decoder that they share."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import cast

from torch import nn

from thermosplat.config import DecoderConfig, ModelConfig
from thermosplat.scene.decoder import Decode, decode_in_parts
from thermosplat.scene.formations.formation import Blended, Common, Formation
from thermosplat.scene.formations.kinds import kind_of, make_decoder
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import Spectrum, first_photograph


class Formations(nn.Module):
    """The formations of a scene's spectra.

    Attributes:
        spectra: The spectra by name, in order.
        decoder: Networks of those whose features are decoded; None where there are none.
        decode: How features are decoded now: ``decoder.decode``, or what ``decoding_by`` has put in its place.

    Args:
        spectra: What is rendered, in order.
    """

    def __init__(self, model: ModelConfig, decoding: DecoderConfig, spectra: Sequence[Spectrum]) -> None:
        super().__init__()
        self.spectra = {spectrum.name: spectrum for spectrum in spectra}
        kinds = {spectrum.name: kind_of(spectrum, model) for spectrum in spectra}
        decoded = [spectrum for spectrum in spectra if kinds[spectrum.name].decodes]
        self.decoder = make_decoder(decoding, model.feature_dim, decoded) if decoded else None
        self.decode: Decode | None = None if self.decoder is None else self.decoder.decode
        common = Common(model, decoding, self.decoder, first_photograph(spectra))
        self.by_spectrum = nn.ModuleDict({one.name: kinds[one.name](one, common) for one in spectra})

    def __getitem__(self, spectrum: str) -> Formation:
        """The formation of a spectrum.

        Raises:
            KeyError: The scene has no such spectrum.
        """
        return cast("Formation", self.by_spectrum[spectrum])

    def form(self, blended: Mapping[str, Blended], rendered: RenderedFrame) -> None:
        """Form the images of spectra of one camera; those that are decoded are decoded together.

        Args:
            blended: What was blended of Gaussians, by spectrum.
            rendered: Takes the images, and what they were formed of.
        """
        seen = {name: self[name].through_optics(one) for name, one in blended.items()}
        inputs = {name: self[name].decoder_input(one.features, one.view) for name, one in seen.items()}
        given = {name: features for name, features in inputs.items() if features is not None}
        decoded = {} if self.decode is None or not given else decode_in_parts(self.decode, given)
        for name in sorted(seen, key=lambda name: self[name].takes_colors):
            formation, one = self[name], seen[name]
            rendered.formations[name] = formation
            rendered.images[name] = formation.render(one, decoded.get(name))
            rendered.alphas[name] = one.alpha
            for parts, part in ((rendered.features, one.features), (rendered.log_depths, one.log_depth)):
                if part is not None:
                    parts[name] = part

    @contextmanager
    def decoding_by(self, decode: Decode) -> Iterator[None]:
        """Within it features are decoded by another function.

        Args:
            decode: Does what ``Decoder.decode`` does.
        """
        usual, self.decode = self.decode, decode
        try:
            yield
        finally:
            self.decode = usual

    def found(self, quantity: str) -> dict[str, float]:
        """What training has found of a quantity (``Formation.numbers``), by the spectra that have it."""
        numbers = {name: self[name].numbers() for name in self.spectra}
        return {name: found[quantity] for name, found in numbers.items() if quantity in found}
