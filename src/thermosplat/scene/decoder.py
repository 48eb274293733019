"""What a decoder is: the networks that turn blended features into images, pixel by pixel.

A class for each choice of ``DecoderConfig.branches`` (``formations.kinds``).
"""

from collections.abc import Callable, Mapping

from torch import Tensor, nn

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
