"""Decoders whose two main branches are fused kernels, where there are kernels for their shape."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from thermosplat.fused.decoders import decode_branches
from thermosplat.fused.decoders import teams as teams_of_shape
from thermosplat.scene.decoder import Decoders


def teams(decoders: Decoders) -> tuple[int, ...]:
    """How many warps may share 16 pixels in the kernels' adjoint, the quickest first; none: there are no kernels."""
    if len(decoders.modulations) != 1 or len(decoders.shared_encoder) != 4:  # two layers and their activations
        return ()
    first = next(decoders.shared_encoder.parameters())
    hidden, features = first.shape
    return teams_of_shape(first.device, hidden, features)


class FusedDecoders:
    """``Decoders.decode`` by fused kernels; parameters stay where they are.

    The kernels have two branches: the spectrum that is modulated, and the one whose prior modulates it. Images of other
    spectra are decoded as by ``Decoders``.

    Args:
        decoders: Decoders that have ``teams``, on a CUDA device.
        team: One of them; None for the quickest.
    """

    def __init__(self, decoders: Decoders, team: int | None = None) -> None:
        self.decoders = decoders
        self.team = teams(decoders)[0] if team is None else team
        (self.modulated,) = decoders.modulations
        self.prior = str(decoders.modulated_by[self.modulated])

    def decode(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """As ``Decoders.decode``."""
        visible, thermal = features.get(self.modulated), features.get(self.prior)
        images = dict(
            zip(
                (self.modulated, self.prior),
                decode_branches(self.team, visible, thermal, self._parameters()),
                strict=True,
            )
        )
        decoded: dict[str, Tensor] = {}
        for name, rendered in features.items():
            image = images.get(name)
            decoded[name] = self.decoders.image(name, rendered) if image is None else image
        return decoded

    def _parameters(self) -> list[Tensor | None]:
        """Weights and biases in the order of ``decode_branches``."""
        d: Any = self.decoders
        layers = [d.shared_encoder[0], d.shared_encoder[2], d.priors[self.prior][0]]
        layers += [d.modulations[self.modulated], d.heads[self.modulated]]
        both = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
        head = dict(d.heads.items()).get(self.prior)
        return [*both, *((None, None) if head is None else (head.weight, head.bias))]
