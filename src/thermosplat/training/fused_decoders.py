"""The decoders' two branches as one Triton kernel each: activations of a pixel never leave the chip.

PyTorch writes every layer's activations to memory and reads them back for the gradient; at 64 channels a pixel that
traffic, not the arithmetic, is what decoding costs. Here a program holds the activations of a block of pixels, the
backward pass computes them again, and gradients of the weights are summed over a program's blocks before they are
written. Matrix products round their inputs to float16, which has the 10 bits of mantissa of TensorFloat-32, and sum in
float32; gradients are brought into float16's range by a power of two, taken from the largest of the image's.

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

PAD = 16
"""Fewest rows and columns of a matrix product: features and image channels are padded to it."""

OPERAND = tl.float16
"""Type that inputs of matrix products are rounded to."""

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
        _forward_kernel[(triton.cdiv(len(pixels), BLOCK_FORWARD),)](
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
        v_features, v_image = features.new_empty(features.shape), v_image.contiguous()
        sizes = [0 if parameter is None else parameter.numel() for parameter in parameters]
        blocks = triton.cdiv(len(pixels), BLOCK_BACKWARD)
        programs = min(_multiprocessors(features.device), blocks)
        partial = features.new_empty(programs, sum(sizes))
        _backward_kernel[(programs,)](
            pixels,
            image,
            v_image,
            torch.exp2(-torch.linalg.vector_norm(v_image, torch.inf).clamp(min=1e-30).log2().ceil()),
            *_pointers(parameters),
            v_features,
            partial,
            len(pixels),
            pixels.stride(0),
            sum(sizes),
            D=dim,
            H=hidden,
            C=channels,
            MODULATED=parameters[6] is not None,
            BLOCK=BLOCK_BACKWARD,
            PADDED=PAD,
            OPERAND=OPERAND,
            TURNS=triton.cdiv(blocks, programs),
            num_warps=WARPS,
            num_stages=1,
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


def _multiprocessors(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 2


@triton.jit
def _weight(weight, rows, columns, IN: tl.constexpr, OUT: tl.constexpr, OPERAND: tl.constexpr):
    """Wᵀ [IN, OUT], padded with zeros to len(rows) x len(columns)."""
    inside = (rows[:, None] < IN) & (columns[None, :] < OUT)
    return tl.load(weight + columns[None, :] * IN + rows[:, None], mask=inside, other=0.0).to(OPERAND)


@triton.jit
def _bias(bias, columns, OUT: tl.constexpr):
    return tl.load(bias + columns, mask=columns < OUT, other=0.0)[None, :]


@triton.jit
def _product(x, y):
    """x y, summed in float32; the inputs are rounded to y's type."""
    return tl.dot(x.to(y.dtype), y, input_precision="ieee")


@triton.jit
def _add_outer(total, x, v, OPERAND: tl.constexpr):
    """Adds xᵀ v: the transposed gradient to a weight."""
    return tl.dot(tl.trans(x.to(OPERAND)), v.to(OPERAND), total, input_precision="ieee")


@triton.jit
def _silu_slope(z):
    s = tl.sigmoid(z)
    return s * (1.0 + z * (1.0 - s))


@triton.jit
def _store_outer(partial, total, rows, columns, IN: tl.constexpr, OUT: tl.constexpr):
    """Stores a transposed gradient [IN, OUT], padded, as [OUT, IN]."""
    inside = (rows[:, None] < IN) & (columns[None, :] < OUT)
    tl.store(partial + columns[None, :] * IN + rows[:, None], total, mask=inside)


@triton.jit
def _forward_kernel(
    features, image, w1, b1, w2, b2, w3, b3, wm, bm, wh, bh, num_pixels, stride,
    D: tl.constexpr, H: tl.constexpr, C: tl.constexpr, MODULATED: tl.constexpr, BLOCK: tl.constexpr,
    PADDED: tl.constexpr, OPERAND: tl.constexpr,
):  # fmt: skip
    """One block of pixels: two shared layers, the prior, [the modulation,] the head."""
    pixel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    narrow, wide = tl.arange(0, PADDED), tl.arange(0, H)
    inside = (pixel[:, None] < num_pixels) & (narrow[None, :] < D)
    x = tl.load(features + pixel[:, None] * stride + narrow[None, :], mask=inside, other=0.0)
    z = _product(x, _weight(w1, narrow, wide, D, H, OPERAND)) + _bias(b1, wide, H)
    z = _product(z * tl.sigmoid(z), _weight(w2, wide, wide, H, H, OPERAND)) + _bias(b2, wide, H)
    encoded = z * tl.sigmoid(z)
    z = _product(encoded, _weight(w3, wide, wide, H, H, OPERAND)) + _bias(b3, wide, H)
    top = z * tl.sigmoid(z)
    if MODULATED:
        gamma = _product(top, _weight(wm, wide, wide, H, H, OPERAND)) + _bias(bm, wide, H)
        beta = _product(top, _weight(wm + H * H, wide, wide, H, H, OPERAND)) + _bias(bm + H, wide, H)
        top = gamma * encoded + beta
    y = tl.sigmoid(_product(top, _weight(wh, wide, narrow, H, C, OPERAND)) + _bias(bh, narrow, C))
    inside = (pixel[:, None] < num_pixels) & (narrow[None, :] < C)
    tl.store(image + pixel[:, None] * C + narrow[None, :], y, mask=inside)


@triton.jit
def _backward_kernel(
    features, image, v_image, scale, w1, b1, w2, b2, w3, b3, wm, bm, wh, bh, v_features, partial, num_pixels, stride,
    num_parameters,
    D: tl.constexpr, H: tl.constexpr, C: tl.constexpr, MODULATED: tl.constexpr, BLOCK: tl.constexpr,
    PADDED: tl.constexpr, OPERAND: tl.constexpr, TURNS: tl.constexpr,
):  # fmt: skip
    """Every so many-th block of pixels: activations again, gradients to features, sums of those to the parameters."""
    narrow, wide = tl.arange(0, PADDED), tl.arange(0, H)
    v_w1, v_wh = tl.zeros((PADDED, H), tl.float32), tl.zeros((H, PADDED), tl.float32)
    v_w2, v_w3 = tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32)
    v_b1, v_b2, v_b3 = tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32)
    v_bh = tl.zeros((PADDED,), tl.float32)
    if MODULATED:
        v_wg, v_wb = tl.zeros((H, H), tl.float32), tl.zeros((H, H), tl.float32)
        v_bg, v_bb = tl.zeros((H,), tl.float32), tl.zeros((H,), tl.float32)
        wg, wb = _weight(wm, wide, wide, H, H, OPERAND), _weight(wm + H * H, wide, wide, H, H, OPERAND)
        bg, bb = _bias(bm, wide, H), _bias(bm + H, wide, H)
    # Loaded before the loop, all weights stay in shared memory.
    w1 = _weight(w1, narrow, wide, D, H, OPERAND)
    w2, w3 = _weight(w2, wide, wide, H, H, OPERAND), _weight(w3, wide, wide, H, H, OPERAND)
    wh = _weight(wh, wide, narrow, H, C, OPERAND)
    b1, b2, b3 = _bias(b1, wide, H), _bias(b2, wide, H), _bias(b3, wide, H)
    factor = tl.load(scale)
    program = tl.program_id(0)
    for turn in range(TURNS):
        pixel = (turn * tl.num_programs(0) + program).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        given = (pixel[:, None] < num_pixels) & (narrow[None, :] < D)
        x = tl.load(features + pixel[:, None] * stride + narrow[None, :], mask=given, other=0.0)
        z1 = _product(x, w1) + b1
        z2 = _product(z1 * tl.sigmoid(z1), w2) + b2
        encoded = z2 * tl.sigmoid(z2)
        z3 = _product(encoded, w3) + b3
        prior = z3 * tl.sigmoid(z3)

        shown = (pixel[:, None] < num_pixels) & (narrow[None, :] < C)
        y = tl.load(image + pixel[:, None] * C + narrow[None, :], mask=shown, other=0.0)
        v = tl.load(v_image + pixel[:, None] * C + narrow[None, :], mask=shown, other=0.0) * y * (1.0 - y) * factor
        v_bh += tl.sum(v, 0)
        v_top = _product(v, tl.trans(wh))
        if MODULATED:
            gamma = _product(prior, wg) + bg
            beta = _product(prior, wb) + bb
            v_wh = _add_outer(v_wh, gamma * encoded + beta, v, OPERAND)
            v_gamma = v_top * encoded
            v_wg = _add_outer(v_wg, prior, v_gamma, OPERAND)
            v_wb = _add_outer(v_wb, prior, v_top, OPERAND)
            v_bg += tl.sum(v_gamma, 0)
            v_bb += tl.sum(v_top, 0)
            v_prior = _product(v_gamma, tl.trans(wg)) + _product(v_top, tl.trans(wb))
            v_encoded = v_top * gamma
        else:
            v_wh = _add_outer(v_wh, prior, v, OPERAND)
            v_prior = v_top
            v_encoded = tl.zeros((BLOCK, H), tl.float32)
        v_z = v_prior * _silu_slope(z3)
        v_w3 = _add_outer(v_w3, encoded, v_z, OPERAND)
        v_b3 += tl.sum(v_z, 0)
        v_z = (v_encoded + _product(v_z, tl.trans(w3))) * _silu_slope(z2)
        v_w2 = _add_outer(v_w2, z1 * tl.sigmoid(z1), v_z, OPERAND)
        v_b2 += tl.sum(v_z, 0)
        v_z = _product(v_z, tl.trans(w2)) * _silu_slope(z1)
        v_w1 = _add_outer(v_w1, x, v_z, OPERAND)
        v_b1 += tl.sum(v_z, 0)
        v_x = _product(v_z, tl.trans(w1))
        tl.store(v_features + pixel[:, None] * D + narrow[None, :], v_x / factor, mask=given)

    # in the order of the parameters
    out = partial + program.to(tl.int64) * num_parameters
    _store_outer(out, v_w1 / factor, narrow, wide, D, H)
    out += D * H
    tl.store(out + wide, v_b1 / factor)
    out += H
    _store_outer(out, v_w2 / factor, wide, wide, H, H)
    out += H * H
    tl.store(out + wide, v_b2 / factor)
    out += H
    _store_outer(out, v_w3 / factor, wide, wide, H, H)
    out += H * H
    tl.store(out + wide, v_b3 / factor)
    out += H
    if MODULATED:
        _store_outer(out, v_wg / factor, wide, wide, H, H)
        out += H * H
        _store_outer(out, v_wb / factor, wide, wide, H, H)
        out += H * H
        tl.store(out + wide, v_bg / factor)
        tl.store(out + H + wide, v_bb / factor)
        out += 2 * H
    _store_outer(out, v_wh / factor, wide, narrow, H, C)
    out += H * C
    tl.store(out + narrow, v_bh / factor, mask=narrow < C)
