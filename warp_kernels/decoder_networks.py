"""The decoders' two branches, features to image and back, a warp's 16 pixels at a time on tensor cores.

Two linear layers with SiLU, the prior's, in the RGB branch its modulation γ ⊙ h + β, the head with a sigmoid. A block
of WARPS warps reads the weights into shared memory once and takes every so many-th block of pixels. Activations stay
in registers. The adjoint computes them again; for the gradients of the weights, sums over all pixels of outer products,
the warps exchange both factors through shared memory, and each adds to its own part of every weight's gradient, in
registers until the end.

Operands are float16, with TensorFloat-32's 10 bits of mantissa; sums are float32. Gradients are brought into float16's
range by a power of two, taken from the largest of the image's. CUDA only (sm_80 and later).
"""

import functools

import warp as wp

from warp_kernels.decoder_memory import (
    ARRAY,
    FOUR,
    MATRIX,
    NARROW,
    THREADS,
    WARPS,
    factor_of,
    layout_of,
    load_bias,
    load_weight,
    read_features,
    read_gradient,
    shared_address,
    store_sums,
    stored,
    sync,
    write_features,
    write_image,
)
from warp_kernels.matrix_fragments import (
    PIXELS,
    Address,
    add_columns,
    add_outer,
    fragments,
    linear,
    linear_adjoint,
    row_bytes,
)

HIDDEN = (32, 64)
"""Channels of hidden layers that there are kernels for."""


@functools.cache
def decoder_kernels(hidden: int, modulated: bool) -> tuple[wp.Kernel, wp.Kernel]:
    """Forward and adjoint kernels.

    Args:
        hidden: channels of hidden layers, of HIDDEN.
        modulated: whether there is a modulation.

    Returns:
        Kernels, launched with (programs, THREADS) threads in blocks of THREADS.
    """
    at, label = layout_of(hidden, modulated), f"{hidden}{'_modulated' if modulated else ''}"
    narrow, wide = fragments(NARROW), fragments(hidden)
    sums16, sums = narrow.sums, wide.sums
    put_narrow, put = narrow.put, wide.put
    rounded16, rounded, widened = narrow.rounded, wide.rounded, wide.widened
    silu, silu_slope = wide.silu, wide.silu_slope
    first_layer, layer, head = linear(NARROW, hidden), linear(hidden, hidden), linear(hidden, NARROW)
    to_features, back = linear_adjoint(NARROW, hidden), linear_adjoint(hidden, hidden)
    from_head = linear_adjoint(hidden, NARROW)
    part_rows, part_columns = hidden // 2, hidden // 4  # a warp's part of a square weight's gradient
    square = add_outer(part_rows, part_columns, hidden, hidden, WARPS)
    beside_features = add_outer(16, 8, hidden, NARROW, WARPS)
    beside_image = add_outer(16, 8, NARROW, hidden, WARPS)
    bias_sums, bias_sums16 = add_columns(hidden, WARPS), add_columns(NARROW, WARPS)
    part = wp.types.vector(part_rows * part_columns // 32, wp.float32)
    biased = part_rows // 16  # of the 4 warps across, those that sum a bias's gradient
    gamma_to_beta = hidden * row_bytes(hidden)
    pixels_of_block = WARPS * PIXELS
    group_narrow, group_wide = PIXELS * row_bytes(NARROW), PIXELS * row_bytes(hidden)

    forward_words, forward_address = shared_address(at.forward_size)
    adjoint_words, adjoint_address = shared_address(at.size)

    @wp.func
    def load_parameters(
        base: Address,
        w1: MATRIX, b1: ARRAY, w2: MATRIX, b2: ARRAY, w3: MATRIX, b3: ARRAY,
        wm: MATRIX, bm: ARRAY, wh: MATRIX, bh: ARRAY,
        thread: int,
    ):  # fmt: skip
        load_weight(w1, hidden, NARROW, base + Address(wp.static(at.w1)), thread)
        load_weight(w2, hidden, hidden, base + Address(wp.static(at.w2)), thread)
        load_weight(w3, hidden, hidden, base + Address(wp.static(at.w3)), thread)
        load_weight(wh, NARROW, hidden, base + Address(wp.static(at.head)), thread)
        load_bias(b1, hidden, base + Address(wp.static(at.b1)), thread)
        load_bias(b2, hidden, base + Address(wp.static(at.b2)), thread)
        load_bias(b3, hidden, base + Address(wp.static(at.b3)), thread)
        load_bias(bh, NARROW, base + Address(wp.static(at.b_head)), thread)
        if wp.static(modulated):
            load_weight(wm, 2 * hidden, hidden, base + Address(wp.static(at.modulation)), thread)
            load_bias(bm, 2 * hidden, base + Address(wp.static(at.b_modulation)), thread)
        sync()

    store_square, store_tile = stored(part_rows // 16, part_columns // 8), stored(1, 1)

    @wp.kernel(name=f"decode_{label}", enable_backward=False, module="unique", launch_bounds=(THREADS, 2))
    def forward(
        programs: int,
        features: MATRIX,
        w1: MATRIX, b1: ARRAY, w2: MATRIX, b2: ARRAY, w3: MATRIX, b3: ARRAY,
        wm: MATRIX, bm: ARRAY, wh: MATRIX, bh: ARRAY,
        image: MATRIX,
    ):  # fmt: skip
        program, thread = wp.tid()
        base = forward_address(wp.tile_empty(shape=forward_words, dtype=wp.int32, storage="shared"))
        load_parameters(base, w1, b1, w2, b2, w3, b3, wm, bm, wh, bh, thread)
        lane = thread & 31
        pixel = program * pixels_of_block + (thread >> 5) * PIXELS
        following = read_features(features, pixel, lane)
        while pixel < image.shape[0]:
            x = following
            following = read_features(features, pixel + programs * pixels_of_block, lane)  # while these are decoded
            a = silu(first_layer(x, base + Address(wp.static(at.w1)), base + Address(wp.static(at.b1)), lane))
            encoded = silu(layer(a, base + Address(wp.static(at.w2)), base + Address(wp.static(at.b2)), lane))
            top = silu(layer(encoded, base + Address(wp.static(at.w3)), base + Address(wp.static(at.b3)), lane))
            if wp.static(modulated):
                modulation = base + Address(wp.static(at.modulation))
                b_modulation = base + Address(wp.static(at.b_modulation))
                gamma = layer(top, modulation, b_modulation, lane)
                beta = layer(top, modulation + Address(gamma_to_beta), b_modulation + Address(4 * hidden), lane)
                top = rounded(wp.cw_mul(gamma, widened(encoded)) + beta)
            z = head(top, base + Address(wp.static(at.head)), base + Address(wp.static(at.b_head)), lane)
            write_image(z, image, pixel, lane)
            pixel += programs * pixels_of_block

    @wp.kernel(name=f"decode_{label}_adjoint", enable_backward=False, module="unique", launch_bounds=(THREADS, 1))
    def adjoint(
        programs: int,
        features: MATRIX,
        image: MATRIX,
        v_image: MATRIX,
        largest: ARRAY,
        w1: MATRIX, b1: ARRAY, w2: MATRIX, b2: ARRAY, w3: MATRIX, b3: ARRAY,
        wm: MATRIX, bm: ARRAY, wh: MATRIX, bh: ARRAY,
        v_features: MATRIX,
        partial: MATRIX,
    ):  # fmt: skip
        program, thread = wp.tid()
        base = adjoint_address(wp.tile_empty(shape=adjoint_words, dtype=wp.int32, storage="shared"))
        load_parameters(base, w1, b1, w2, b2, w3, b3, wm, bm, wh, bh, thread)
        lane = thread & 31
        warp = thread >> 5
        factor = factor_of(largest[0])
        weight2, weight3 = base + Address(wp.static(at.w2)), base + Address(wp.static(at.w3))
        weight1, head_weight = base + Address(wp.static(at.w1)), base + Address(wp.static(at.head))
        modulation = base + Address(wp.static(at.modulation))
        b_modulation = base + Address(wp.static(at.b_modulation))
        # the block's matrices, and this warp's rows of them
        all_x, all_first = base + Address(wp.static(at.features)), base + Address(wp.static(at.first))
        all_encoded, all_prior = base + Address(wp.static(at.encoded)), base + Address(wp.static(at.prior))
        all_v = base + Address(wp.static(at.v_image))
        even, odd = base + Address(wp.static(at.factors[0])), base + Address(wp.static(at.factors[1]))
        mine_narrow, mine = Address(warp * group_narrow), Address(warp * group_wide)
        # this warp's part of the square weights' gradients
        down, across = warp >> 2, warp & 3
        row, column = down * part_rows, across * part_columns
        bias_row = row + across * 16
        v_w2 = part()
        v_w3 = part()
        v_wg = part()
        v_wb = part()
        v_b2 = FOUR()
        v_b3 = FOUR()
        v_bg = FOUR()
        v_bb = FOUR()
        v_w1 = FOUR()
        v_wh = FOUR()
        v_bh = FOUR()
        pixel = program * pixels_of_block + warp * PIXELS
        x = read_features(features, pixel, lane)
        v = rounded16(read_gradient(image, v_image, factor, pixel, lane))
        while pixel - warp * PIXELS < image.shape[0]:
            put_narrow(x, all_x + mine_narrow, lane)
            z = first_layer(x, weight1, base + Address(wp.static(at.b1)), lane)
            a = silu(z)
            put(a, all_first + mine, lane)
            z = layer(a, weight2, base + Address(wp.static(at.b2)), lane)
            encoded = silu(z)
            slope2 = silu_slope(z)
            put(encoded, all_encoded + mine, lane)
            z = layer(encoded, weight3, base + Address(wp.static(at.b3)), lane)
            prior = silu(z)
            slope3 = silu_slope(z)
            put(prior, all_prior + mine, lane)
            put_narrow(v, all_v + mine_narrow, lane)
            v_encoded = sums()
            v_prior = sums()
            if wp.static(modulated):
                gamma = layer(prior, modulation, b_modulation, lane)
                beta = layer(prior, modulation + Address(gamma_to_beta), b_modulation + Address(4 * hidden), lane)
                h = widened(encoded)
                put(rounded(wp.cw_mul(gamma, h) + beta), odd + mine, lane)
                v_top = from_head(v, head_weight, sums(), lane)  # not before: it needs registers
                v_encoded = wp.cw_mul(v_top, gamma)
                v_gamma = rounded(wp.cw_mul(v_top, h))
                v_beta = rounded(v_top)
                put(v_gamma, even + mine, lane)
                sync()
                if warp * 8 < hidden:
                    v_wh = beside_image(all_v, odd, 0, warp * 8, v_wh, lane)
                v_wg = square(even, all_prior, row, column, v_wg, lane)
                if across < biased:
                    v_bg = bias_sums(even, bias_row, v_bg, lane)
                v_prior = back(v_gamma, modulation, sums(), lane)
                v_prior = back(v_beta, modulation + Address(gamma_to_beta), v_prior, lane)
                sync()  # the head's input has been read
                put(v_beta, odd + mine, lane)
                sync()
                v_wb = square(odd, all_prior, row, column, v_wb, lane)
                if across < biased:
                    v_bb = bias_sums(odd, bias_row, v_bb, lane)
            else:
                v_prior = from_head(v, head_weight, sums(), lane)
            v_z = rounded(wp.cw_mul(v_prior, widened(slope3)))
            put(v_z, even + mine, lane)
            sync()
            if wp.static(not modulated):
                if warp * 8 < hidden:
                    v_wh = beside_image(all_v, all_prior, 0, warp * 8, v_wh, lane)
            if warp == 0:
                v_bh = bias_sums16(all_v, 0, v_bh, lane)
            v_w3 = square(even, all_encoded, row, column, v_w3, lane)
            if across < biased:
                v_b3 = bias_sums(even, bias_row, v_b3, lane)
            v_z = rounded(wp.cw_mul(back(v_z, weight3, v_encoded, lane), widened(slope2)))
            put(v_z, odd + mine, lane)
            sync()
            v_w2 = square(odd, all_first, row, column, v_w2, lane)
            if across < biased:
                v_b2 = bias_sums(odd, bias_row, v_b2, lane)
            z = first_layer(x, weight1, base + Address(wp.static(at.b1)), lane)  # again: quick, and takes no registers
            v_z = rounded(wp.cw_mul(back(v_z, weight2, sums(), lane), widened(silu_slope(z))))
            put(v_z, even + mine, lane)
            following = pixel + programs * pixels_of_block
            x = read_features(features, following, lane)  # the next, while these are finished
            v = rounded16(read_gradient(image, v_image, factor, following, lane))
            sync()
            if warp * 8 < hidden:
                v_w1 = beside_features(even, all_x, (warp >> 1) * 16, (warp & 1) * 8, v_w1, lane)
            write_features(to_features(v_z, weight1, sums16(), lane), v_features, 1.0 / factor, pixel, lane)
            sync()
            pixel = following
        unscaled = 1.0 / factor
        out = partial[program]
        dim, channels = features.shape[1], image.shape[1]
        if warp * 8 < hidden:
            store_tile(v_w1, out, 0, hidden, dim, (warp >> 1) * 16, (warp & 1) * 8, True, unscaled, lane)
        first = (dim + 1) * hidden
        store_square(v_w2, out, first, hidden, hidden, row, column, False, unscaled, lane)
        if across < biased:
            store_sums(v_b2, out, first + hidden * hidden, hidden, bias_row, unscaled, lane)
        first += (hidden + 1) * hidden
        store_square(v_w3, out, first, hidden, hidden, row, column, False, unscaled, lane)
        if across < biased:
            store_sums(v_b3, out, first + hidden * hidden, hidden, bias_row, unscaled, lane)
        first += (hidden + 1) * hidden
        if wp.static(modulated):
            store_square(v_wg, out, first, hidden, hidden, row, column, False, unscaled, lane)
            store_square(v_wb, out, first + hidden * hidden, hidden, hidden, row, column, False, unscaled, lane)
            if across < biased:
                store_sums(v_bg, out, first + 2 * hidden * hidden, hidden, bias_row, unscaled, lane)
                store_sums(v_bb, out, first + (2 * hidden + 1) * hidden, hidden, bias_row, unscaled, lane)
            first += 2 * (hidden + 1) * hidden
        if warp * 8 < hidden:
            store_tile(v_wh, out, first, channels, hidden, 0, warp * 8, False, unscaled, lane)
        if warp == 0:
            store_sums(v_bh, out, first + channels * hidden, channels, 0, unscaled, lane)

    return forward, adjoint
