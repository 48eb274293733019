"""Triton kernels of the decoders; fused_decoders.py launches them and says why they are as they are.

Pixels are rows. Channels are padded with zeros: features and image channels to PADDED, H is a power of two. Parameters
have the shapes of ``torch.nn.Linear``; MODULATED tells the RGB branch (prior, modulation, head) from the thermal one
(prior, head).
"""

import triton
import triton.language as tl

LARGEST = tl.constexpr(65504.0)  # of float16


@triton.jit
def _rounded(x, OPERAND: tl.constexpr):
    """x as an operand. Beyond float16 it is the largest there is, not infinite, which times 0 would be NaN."""
    return tl.clamp(x, -LARGEST, LARGEST, propagate_nan=tl.PropagateNan.ALL).to(OPERAND)


@triton.jit
def _weight(weight, rows, columns, IN: tl.constexpr, OUT: tl.constexpr, OPERAND: tl.constexpr):
    """Wᵀ [IN, OUT], padded with zeros to len(rows) x len(columns)."""
    inside = (rows[:, None] < IN) & (columns[None, :] < OUT)
    return _rounded(tl.load(weight + columns[None, :] * IN + rows[:, None], mask=inside, other=0.0), OPERAND)


@triton.jit
def _bias(bias, columns, OUT: tl.constexpr):
    return tl.load(bias + columns, mask=columns < OUT, other=0.0)[None, :]


@triton.jit
def _product(x, y):
    """x y, summed in float32; the inputs are rounded to y's type."""
    return tl.dot(_rounded(x, y.dtype), y, input_precision="ieee")


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
def forward_kernel(
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
def _keep(factors, slot, pixel, wide, num_pixels, value, H: tl.constexpr):
    """Stores a factor [BLOCK, H] of a weight's gradient."""
    place = (slot * num_pixels.to(tl.int64) + pixel[:, None]) * H + wide[None, :]
    tl.store(factors + place, _rounded(value, factors.dtype.element_ty), mask=pixel[:, None] < num_pixels)


@triton.jit
def _kept(factors, slot, pixel, wide, num_pixels, H: tl.constexpr):
    place = (slot * num_pixels.to(tl.int64) + pixel[:, None]) * H + wide[None, :]
    return tl.load(factors + place, mask=pixel[:, None] < num_pixels, other=0.0)


@triton.jit
def _scale(largest):
    """The power of two that brings gradients up to so large a one into float16's range, to at most 1."""
    return tl.exp2(-tl.ceil(tl.log2(tl.maximum(tl.load(largest), 1e-30))))


@triton.jit
def _before_sigmoid(image, v_image, largest, pixel, narrow, num_pixels, C: tl.constexpr):
    """Scaled gradient to what the image is the sigmoid of."""
    shown = (pixel[:, None] < num_pixels) & (narrow[None, :] < C)
    y = tl.load(image + pixel[:, None] * C + narrow[None, :], mask=shown, other=0.0)
    v = tl.load(v_image + pixel[:, None] * C + narrow[None, :], mask=shown, other=0.0)
    return v * y * (1.0 - y) * _scale(largest)


@triton.jit
def backward_kernel(
    features, image, v_image, largest, w1, b1, w2, b2, w3, b3, wm, bm, wh, bh, v_features, factors, num_pixels, stride,
    D: tl.constexpr, H: tl.constexpr, C: tl.constexpr, MODULATED: tl.constexpr, BLOCK: tl.constexpr,
    PADDED: tl.constexpr, OPERAND: tl.constexpr,
):  # fmt: skip
    """One block of pixels: activations again, gradients to the features, and the factors of the weights' gradients.

    Factors by slot: 0 first layer's activation, 1 gradient before it; 2, 3 second layer's; 4, 5 the prior's; with a
    modulation 6 gradient to γ, 7 gradient to β, 8 the head's input.
    """
    pixel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    narrow, wide = tl.arange(0, PADDED), tl.arange(0, H)
    given = (pixel[:, None] < num_pixels) & (narrow[None, :] < D)
    x = tl.load(features + pixel[:, None] * stride + narrow[None, :], mask=given, other=0.0)
    w1 = _weight(w1, narrow, wide, D, H, OPERAND)
    w2, w3 = _weight(w2, wide, wide, H, H, OPERAND), _weight(w3, wide, wide, H, H, OPERAND)
    z1 = _product(x, w1) + _bias(b1, wide, H)
    a1 = z1 * tl.sigmoid(z1)
    _keep(factors, 0, pixel, wide, num_pixels, a1, H)
    z2 = _product(a1, w2) + _bias(b2, wide, H)
    encoded = z2 * tl.sigmoid(z2)
    _keep(factors, 2, pixel, wide, num_pixels, encoded, H)
    z3 = _product(encoded, w3) + _bias(b3, wide, H)
    prior = z3 * tl.sigmoid(z3)
    _keep(factors, 4, pixel, wide, num_pixels, prior, H)

    v = _before_sigmoid(image, v_image, largest, pixel, narrow, num_pixels, C)
    v_top = _product(v, tl.trans(_weight(wh, wide, narrow, H, C, OPERAND)))
    if MODULATED:
        wg, wb = _weight(wm, wide, wide, H, H, OPERAND), _weight(wm + H * H, wide, wide, H, H, OPERAND)
        gamma = _product(prior, wg) + _bias(bm, wide, H)
        beta = _product(prior, wb) + _bias(bm + H, wide, H)
        _keep(factors, 8, pixel, wide, num_pixels, gamma * encoded + beta, H)
        v_gamma = v_top * encoded
        _keep(factors, 6, pixel, wide, num_pixels, v_gamma, H)
        _keep(factors, 7, pixel, wide, num_pixels, v_top, H)
        v_prior = _product(v_gamma, tl.trans(wg)) + _product(v_top, tl.trans(wb))
        v_encoded = v_top * gamma
    else:
        v_prior = v_top
        v_encoded = tl.zeros((BLOCK, H), tl.float32)
    v_z = v_prior * _silu_slope(z3)
    _keep(factors, 5, pixel, wide, num_pixels, v_z, H)
    v_z = (v_encoded + _product(v_z, tl.trans(w3))) * _silu_slope(z2)
    _keep(factors, 3, pixel, wide, num_pixels, v_z, H)
    v_z = _product(v_z, tl.trans(w2)) * _silu_slope(z1)
    _keep(factors, 1, pixel, wide, num_pixels, v_z, H)
    v_x = _product(v_z, tl.trans(w1)) / _scale(largest)
    tl.store(v_features + pixel[:, None] * D + narrow[None, :], v_x, mask=given)


@triton.jit
def _square_weights(
    factors, factor, partial, which, num_pixels, num_parameters,
    D: tl.constexpr, H: tl.constexpr, BLOCK: tl.constexpr, TURNS: tl.constexpr,
):  # fmt: skip
    """One of w2, w3 [and the halves of wm], and its bias."""
    wide = tl.arange(0, H)
    program = tl.program_id(0)
    first = tl.minimum(2 * which, 4)  # slots of the factors: (0, 3), (2, 5), (4, 6), (4, 7)
    second = tl.where(which < 2, 3 + 2 * which, 4 + which)
    total, bias = tl.zeros((H, H), tl.float32), tl.zeros((H,), tl.float32)
    for turn in range(TURNS):
        pixel = (turn * tl.num_programs(0) + program).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        v = _kept(factors, second, pixel, wide, num_pixels, H)
        x = _kept(factors, first, pixel, wide, num_pixels, H)
        total = tl.dot(tl.trans(x), v, total, input_precision="ieee")
        bias += tl.sum(v.to(tl.float32), 0)
    out = partial + program.to(tl.int64) * num_parameters + (D + 1) * H  # in the order of the parameters
    if which < 2:
        out += which * (H + 1) * H
        _store_outer(out, total / factor, wide, wide, H, H)
        tl.store(out + H * H + wide, bias / factor)
    else:
        out += 2 * (H + 1) * H
        _store_outer(out + (which - 2) * H * H, total / factor, wide, wide, H, H)
        tl.store(out + 2 * H * H + (which - 2) * H + wide, bias / factor)


@triton.jit
def _narrow_weights(
    features, image, v_image, largest, factors, factor, partial, num_pixels, stride, num_parameters,
    D: tl.constexpr, H: tl.constexpr, C: tl.constexpr, MODULATED: tl.constexpr, BLOCK: tl.constexpr,
    PADDED: tl.constexpr, OPERAND: tl.constexpr, TURNS: tl.constexpr,
):  # fmt: skip
    """w1, the head's weight, and their biases."""
    narrow, wide = tl.arange(0, PADDED), tl.arange(0, H)
    program = tl.program_id(0)
    v_w1, v_wh = tl.zeros((PADDED, H), tl.float32), tl.zeros((H, PADDED), tl.float32)
    v_b1, v_bh = tl.zeros((H,), tl.float32), tl.zeros((PADDED,), tl.float32)
    for turn in range(TURNS):
        pixel = (turn * tl.num_programs(0) + program).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        given = (pixel[:, None] < num_pixels) & (narrow[None, :] < D)
        x = tl.load(features + pixel[:, None] * stride + narrow[None, :], mask=given, other=0.0)
        v = _kept(factors, 1, pixel, wide, num_pixels, H)
        v_w1 = tl.dot(tl.trans(_rounded(x, OPERAND)), v, v_w1, input_precision="ieee")
        v_b1 += tl.sum(v.to(tl.float32), 0)
        v = _before_sigmoid(image, v_image, largest, pixel, narrow, num_pixels, C)
        top = _kept(factors, 8 if MODULATED else 4, pixel, wide, num_pixels, H)
        v_wh = tl.dot(tl.trans(top), _rounded(v, OPERAND), v_wh, input_precision="ieee")
        v_bh += tl.sum(v, 0)
    out = partial + program.to(tl.int64) * num_parameters
    _store_outer(out, v_w1 / factor, narrow, wide, D, H)
    tl.store(out + D * H + wide, v_b1 / factor)
    out += num_parameters - (H + 1) * C
    _store_outer(out, v_wh / factor, wide, narrow, H, C)
    tl.store(out + H * C + narrow, v_bh / factor, mask=narrow < C)


@triton.jit
def weights_kernel(
    features, image, v_image, largest, factors, partial, num_pixels, stride, num_parameters,
    D: tl.constexpr, H: tl.constexpr, C: tl.constexpr, MODULATED: tl.constexpr, BLOCK: tl.constexpr,
    PADDED: tl.constexpr, OPERAND: tl.constexpr, TURNS: tl.constexpr,
):  # fmt: skip
    """Gradients of the weights: each program sums every so many-th block of pixels for one product of factors.

    Programs of all products run side by side: those of one are too few to keep a large GPU's memory busy.
    """
    factor = _scale(largest)
    which = tl.program_id(1)
    if which == 0:  # has the most to do, so it begins first
        _narrow_weights(
            features, image, v_image, largest, factors, factor, partial, num_pixels, stride, num_parameters,
            D, H, C, MODULATED, BLOCK, PADDED, OPERAND, TURNS,
        )  # fmt: skip
    else:
        _square_weights(factors, factor, partial, which - 1, num_pixels, num_parameters, D, H, BLOCK, TURNS)
