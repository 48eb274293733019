"""Large images are decoded some rows at a time where nothing is learnt: hidden layers take twenty times the image."""

from collections.abc import Mapping

import torch
from torch import Tensor

from thermosplat.scene.decoder import Decode

PIXELS_AT_ONCE = 1 << 19
"""With 64 hidden channels a layer of so many takes 128 MiB."""


def decode_in_parts(decode: Decode, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The decoded images of some spectra, as ``decode`` gives them.

    Args:
        decode: A decoder's.
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
