"""Large images are decoded some rows at a time where nothing is learnt: hidden layers take twenty times the image."""

from collections.abc import Mapping

import torch
from torch import Tensor

from thermosplat.scene.decoders import Decoders
from thermosplat.scene.spectrum_decoders import SpectrumDecoders

PIXELS_AT_ONCE = 1 << 19
"""With 64 hidden channels a layer of so many takes 128 MiB."""


def decode_in_parts(decoders: Decoders | SpectrumDecoders, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The decoded images of some spectra, as ``decoders.decode`` gives them.

    Args:
        decoders: The decoders.
        inputs: What they take by spectrum, at least one, all of shape [H, W, d].
    """
    height, width = next(iter(inputs.values())).shape[:2]
    rows = max(1, PIXELS_AT_ONCE // max(1, width))
    if torch.is_grad_enabled() or rows >= height:
        return decoders.decode(inputs)
    parts = [
        decoders.decode({name: values[top : top + rows] for name, values in inputs.items()})
        for top in range(0, height, rows)
    ]
    return {name: torch.cat([part[name] for part in parts]) for name in inputs}
