"""The decoders' two branches as one Triton kernel each: activations of a pixel do not leave the chip.

PyTorch writes every layer's activations to memory and reads them back for the gradient; at 64 channels a pixel that
traffic, not the arithmetic, is what decoding costs. Here a program holds the activations of a block of pixels, and the
backward pass computes them again. For the gradients of the weights, sums over all pixels that do not fit a program's
registers beside the rest, it writes what they are products of, in 16 bits, and a further kernel sums.

Matrix products round their inputs to float16, which has the 10 bits of mantissa of TensorFloat-32, and sum in float32;
gradients are brought into float16's range by a power of two, taken from the largest of the image's.

The networks are those of decoders.py with two shared layers; ``fits`` says for which this file has kernels.
"""

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.decoders import Decoders
from thermosplat.training.decoder_kernels import (
    backward_kernel,
    forward_kernel,
    weights_kernel,
)

PAD = 16
"""Fewest rows and columns of a matrix product: features and image channels are padded to it."""

PROGRAMS = 256
"""Partial sums of the weights' gradients."""

OPERAND = tl.float16
"""Type that inputs of matrix products are rounded to."""

_STORED = {tl.float16: torch.float16, tl.float32: torch.float32}

BLOCK_FORWARD, BLOCK_BACKWARD, WARPS = 64, 64, 4
"""Pixels a program holds at a time, and its warps; see benchmarks/notes.md."""


def fits(decoders: Decoders) -> bool:
    """Whether decoders have the shape these kernels are written for.

    Args:
        decoders: Any of that class.
    """
    if decoders.modulation is None or len(decoders.shared_encoder) != 4:  # two layers and their activations
        return False
    hidden, dim = next(decoders.shared_encoder.parameters()).shape
    return hidden in (16, 32, 64) and dim <= PAD


class FusedDecoders:
    """The branches of ``Decoders`` by fused kernels; parameters stay where they are.

    Args:
        decoders: Decoders that ``fits``, on a CUDA device.
    """

    def __init__(self, decoders: Decoders) -> None:
        self.decoders = decoders

    def rgb(self, visible_features: Tensor) -> Tensor:
        """As ``Decoders.rgb``."""
        d = self.decoders
        return _Branch.apply(visible_features, *self._shared(), *_parameters(d.modulation), *_parameters(d.rgb_head))

    def thermal(self, thermal_features: Tensor) -> Tensor:
        """As ``Decoders.thermal``."""
        if self.decoders.thermal_head is None:
            raise ValueError("These decoders were made with thermal_channels=0; they have no thermal image.")
        return _Branch.apply(thermal_features, *self._shared(), None, None, *_parameters(self.decoders.thermal_head))

    def both(self, visible_features: Tensor, thermal_features: Tensor) -> tuple[Tensor, Tensor]:
        """As ``Decoders.both``."""
        return self.rgb(visible_features), self.thermal(thermal_features)

    def _shared(self) -> list[Tensor]:
        d = self.decoders
        return [*_parameters(d.shared_encoder[0]), *_parameters(d.shared_encoder[2]), *_parameters(d.thermal_prior[0])]


def _parameters(layer: Any) -> tuple[Tensor, Tensor]:
    return layer.weight, layer.bias


class _Branch(torch.autograd.Function):
    """Features [..., d] to an image [..., channels]; with a modulation the RGB branch, without it the thermal one."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, *parameters: Any) -> Tensor:
        pixels = _pixels(features)
        dim, hidden, channels = pixels.shape[1], parameters[0].shape[0], parameters[-1].shape[0]
        image = features.new_empty(*features.shape[:-1], channels)
        forward_kernel[(triton.cdiv(len(pixels), BLOCK_FORWARD),)](
            pixels,
            image,
            *_pointers(parameters),
            len(pixels),
            pixels.stride(0),
            D=dim,
            H=hidden,
            C=channels,
            MODULATED=parameters[6] is not None,
            BLOCK=BLOCK_FORWARD,
            PADDED=PAD,
            OPERAND=OPERAND,
            num_warps=WARPS,
        )
        ctx.save_for_backward(features, image, *parameters)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor) -> tuple[Tensor | None, ...]:
        features, image, *parameters = ctx.saved_tensors
        pixels = _pixels(features)
        dim, hidden, channels = pixels.shape[1], parameters[0].shape[0], image.shape[-1]
        modulated = parameters[6] is not None
        v_features, v_image = features.new_empty(features.shape), v_image.contiguous()
        largest = torch.linalg.vector_norm(v_image, torch.inf)
        sizes = [0 if parameter is None else parameter.numel() for parameter in parameters]
        slots = 9 if modulated else 6
        factors = torch.empty(slots, len(pixels), hidden, dtype=_STORED[OPERAND], device=features.device)
        blocks = triton.cdiv(len(pixels), BLOCK_BACKWARD)
        shape: dict[str, Any] = {"D": dim, "H": hidden, "C": channels, "MODULATED": modulated, "PADDED": PAD}
        shape |= {"OPERAND": OPERAND, "BLOCK": BLOCK_BACKWARD, "num_warps": WARPS}
        backward_kernel[(blocks,)](
            pixels,
            image,
            v_image,
            largest,
            *_pointers(parameters),
            v_features,
            factors,
            len(pixels),
            pixels.stride(0),
            **shape,
        )
        programs = min(PROGRAMS, blocks)
        partial = features.new_empty(programs, sum(sizes))
        shape |= {"TURNS": triton.cdiv(blocks, programs)}
        weights_kernel[(programs, 5 if modulated else 3)](
            pixels, image, v_image, largest, factors, partial, len(pixels), pixels.stride(0), sum(sizes), **shape
        )
        sums = partial.sum(0).split(sizes)
        v_parameters = [
            None if parameter is None else total.view(parameter.shape)
            for parameter, total in zip(parameters, sums, strict=True)
        ]
        return v_features, *v_parameters


def _pixels(features: Tensor) -> Tensor:
    """[..., d] as [pixels, d] on the same memory where the channels lie side by side, as in a slice of a render."""
    rows = features.reshape(-1, features.shape[-1]) if features.is_contiguous() else features.flatten(0, -2)
    return rows if rows.stride(1) == 1 else rows.contiguous()


def _pointers(parameters: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Parameters for the kernels; where there is no modulation they are given the first weight, and do not read it."""
    return [parameters[0] if parameter is None else parameter for parameter in parameters]
