"""The adjoint of the decoders' two branches: gradients of features, weights and biases.

A block computes the activations of its pixels again. For the gradients of the weights, sums over all pixels of outer
products, its warps exchange both factors through shared memory, and each adds to its own part of every weight's
gradient, in registers until the end. Gradients are brought into float16's range by a power of two, taken from the
largest of the image's.

Where there is room, a warp has 16 pixels to itself and their activations stay in its registers. Consumer GPUs allow a
block 99 KB of shared memory, which holds the factors of half as many pixels: there two warps, a team, share 16 pixels.
Each computes half the channels of every layer and reads both halves from shared memory, where they are needed anyway.
"""

import warp as wp

from warp_kernels.decoding.decoder_memory import (
    ARRAY,
    FOUR,
    MATRIX,
    NARROW,
    THREADS,
    WARPS,
    factor_of,
    feature_reader,
    feature_writer,
    layout_of,
    program_of_grid,
    read_gradient,
    shared_address,
    store_sums,
    stored,
    sync,
    team_sync,
    thread_of_block,
    unscaled_of,
)
from warp_kernels.decoding.decoder_networks import label_of, parameter_loader
from warp_kernels.decoding.matrix_fragments import (
    PIXELS,
    Address,
    add_columns,
    add_outer,
    fragments,
    linear,
    linear_adjoint,
    row_bytes,
)
from warp_kernels.machinery.loading import made_once


@made_once
def decode_adjoint_kernel(hidden: int, modulated: bool, inputs: int, team: int) -> wp.Kernel:
    """The adjoint kernel of a branch.

    Args:
        hidden: channels of hidden layers, of HIDDEN.
        modulated: whether there is a modulation.
        inputs: columns of features, of INPUTS.
        team: warps that share 16 pixels, of TEAMS.

    Returns:
        A kernel, launched with (programs, THREADS) threads in blocks of THREADS, one a multiprocessor. Each program
        writes its own row of ``partial``: gradients of the weights and biases in the order of the arguments.
    """
    at = layout_of(hidden, modulated, inputs, team)
    load_parameters = parameter_loader(hidden, modulated, inputs)
    read_features, write_features = feature_reader(inputs), feature_writer(inputs)
    name = f"{label_of(hidden, modulated, inputs)}_adjoint{'' if team == 1 else f'_team{team}'}"
    words, address = shared_address(at.size)

    # a warp's channels of hidden layers
    own = hidden // team
    of_features, narrow, wide = fragments(inputs), fragments(NARROW), fragments(own, hidden)
    feature_sums, sums = of_features.sums, wide.sums
    put_features, put_narrow, put = of_features.put, narrow.put, wide.put
    get_features, get_own, get = of_features.get, wide.get, fragments(hidden).get
    rounded16, rounded, widened = narrow.rounded, wide.rounded, wide.widened
    silu, silu_slope = wide.silu, wide.silu_slope
    (first_layer, _), (layer, _) = linear(inputs, own), linear(hidden, own)
    to_features, back = linear_adjoint(inputs, hidden), linear_adjoint(own, hidden, hidden)
    from_head = linear_adjoint(own, NARROW, hidden)
    gamma_to_beta = hidden * row_bytes(hidden)
    own_first, own_wide = own * row_bytes(inputs), own * row_bytes(hidden)

    # all warps' pixels
    teams, team_bits = WARPS // team, team.bit_length() - 1
    pixels_of_block = teams * PIXELS
    team_features, team_narrow, team_wide = (PIXELS * row_bytes(columns) for columns in (inputs, NARROW, hidden))
    wait_for_team = team_sync(team)

    # a warp's part of the weights' gradients
    part_rows, part_columns = hidden // 2, hidden // 4
    part = wp.types.vector(part_rows * part_columns // 32, wp.float32)
    square = add_outer(part_rows, part_columns, hidden, hidden, teams)
    half_inputs = inputs // 2
    part_of_w1 = wp.types.vector(half_inputs // 2, wp.float32)
    beside_features = add_outer(16, half_inputs, hidden, inputs, teams)
    beside_image = add_outer(16, 8, NARROW, hidden, teams)
    bias_sums, bias_sums16 = add_columns(hidden, teams), add_columns(NARROW, teams)
    biased = part_rows // 16  # of the 4 warps across, those that sum a bias's gradient
    store_square = stored(part_rows // 16, part_columns // 8)
    store_w1, store_wh = stored(1, half_inputs // 8), stored(1, 1)

    # All channels of a team's pixels: what this warp has of them, or what all have put in these rows.
    if team == 1:

        @wp.func
        def whole(p: wide.packed, rows: Address, lane: int) -> wide.packed:
            return p
    else:

        @wp.func
        def whole(p: wide.packed, rows: Address, lane: int) -> fragments(hidden).packed:
            return get(rows, lane)

    @wp.kernel(name=name, enable_backward=False, module="unique", launch_bounds=(THREADS, 1), grid_stride=False)
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
        program, thread = program_of_grid(), thread_of_block()
        base = address(wp.tile_empty(shape=words, dtype=wp.int32, storage="shared"))
        load_parameters(base, w1, b1, w2, b2, w3, b3, wm, bm, wh, bh, thread)
        lane = thread & 31
        warp = thread >> 5
        my_team, member = warp >> team_bits, warp & (team - 1)
        factor, unscaled = factor_of(largest[0]), unscaled_of(largest[0])
        # this warp's channels: rows of weights on the way there, columns on the way back
        rows, of_columns, of_biases = Address(member * own_wide), Address(member * own * 2), Address(member * own * 4)
        weight1, weight2 = base + Address(wp.static(at.w1)), base + Address(wp.static(at.w2))
        weight3, head_weight = base + Address(wp.static(at.w3)), base + Address(wp.static(at.head))
        modulation = base + Address(wp.static(at.modulation))
        rows1 = weight1 + Address(member * own_first)
        bias1, bias2 = base + Address(wp.static(at.b1)) + of_biases, base + Address(wp.static(at.b2)) + of_biases
        bias3 = base + Address(wp.static(at.b3)) + of_biases
        b_modulation = base + Address(wp.static(at.b_modulation)) + of_biases
        # the block's matrices, and the rows and channels of them that are this warp's
        all_x, all_first = base + Address(wp.static(at.features)), base + Address(wp.static(at.first))
        all_encoded, all_prior = base + Address(wp.static(at.encoded)), base + Address(wp.static(at.prior))
        all_v = base + Address(wp.static(at.v_image))
        even, odd = base + Address(wp.static(at.factors[0])), base + Address(wp.static(at.factors[1]))
        ours_features, ours_narrow = Address(my_team * team_features), Address(my_team * team_narrow)
        ours = Address(my_team * team_wide)
        mine = ours + of_columns
        # this warp's part of the square weights' gradients
        down, across = warp >> 2, warp & 3
        row, column = down * part_rows, across * part_columns
        bias_row = row + across * 16
        v_w2 = part()
        v_w3 = part()
        v_wg = part()
        v_wb = part()
        v_biases = FOUR()  # of the square weights' layers, each in its place
        v_w1 = part_of_w1()
        v_wh = FOUR()
        v_bh = FOUR()
        pixel = program * pixels_of_block + my_team * PIXELS
        x = read_features(features, pixel, lane)
        v = rounded16(read_gradient(image, v_image, factor, pixel, lane))
        while pixel - my_team * PIXELS < image.shape[0]:
            if member == 0:
                put_features(x, all_x + ours_features, lane)
            z = first_layer(x, rows1, bias1, lane)
            a = silu(z)
            put(a, all_first + mine, lane)
            wait_for_team(my_team)
            z = layer(whole(a, all_first + ours, lane), weight2 + rows, bias2, lane)
            encoded = silu(z)
            slope2 = silu_slope(z)
            put(encoded, all_encoded + mine, lane)
            wait_for_team(my_team)
            z = layer(whole(encoded, all_encoded + ours, lane), weight3 + rows, bias3, lane)
            prior = silu(z)
            slope3 = silu_slope(z)
            put(prior, all_prior + mine, lane)
            if member == 0:
                put_narrow(v, all_v + ours_narrow, lane)
            v_encoded = sums()
            v_prior = sums()
            if wp.static(modulated):
                wait_for_team(my_team)
                whole_prior = whole(prior, all_prior + ours, lane)
                gamma = layer(whole_prior, modulation + rows, b_modulation, lane)
                beta = layer(
                    whole_prior, modulation + rows + Address(gamma_to_beta), b_modulation + Address(4 * hidden), lane
                )
                if wp.static(team > 1):  # registers are short
                    encoded = get_own(all_encoded + mine, lane)
                h = widened(encoded)
                put(rounded(wp.cw_mul(gamma, h) + beta), odd + mine, lane)
                v_top = from_head(v, head_weight + of_columns, sums(), lane)  # not before: it needs registers
                v_encoded = wp.cw_mul(v_top, gamma)
                v_gamma = rounded(wp.cw_mul(v_top, h))
                v_beta = rounded(v_top)
                put(v_gamma, even + mine, lane)
                sync()
                if warp * 8 < hidden:
                    v_wh = beside_image(all_v, odd, 0, warp * 8, v_wh, lane)
                v_wg = square(even, all_prior, row, column, v_wg, lane)
                if across < biased:
                    v_biases = bias_sums(even, bias_row, 2, v_biases, lane)
                beta_columns = modulation + of_columns + Address(gamma_to_beta)
                v_prior = back(whole(v_gamma, even + ours, lane), modulation + of_columns, sums(), lane)
                if wp.static(team == 1):  # before others wait, and registers for v_beta are free
                    v_prior = back(whole(v_beta, odd + ours, lane), beta_columns, v_prior, lane)
                sync()  # the head's input has been read
                put(v_beta, odd + mine, lane)
                sync()
                if wp.static(team > 1):
                    v_prior = back(whole(v_beta, odd + ours, lane), beta_columns, v_prior, lane)
                v_wb = square(odd, all_prior, row, column, v_wb, lane)
                if across < biased:
                    v_biases = bias_sums(odd, bias_row, 3, v_biases, lane)
            else:
                v_prior = from_head(v, head_weight + of_columns, sums(), lane)
            v_z = rounded(wp.cw_mul(v_prior, widened(slope3)))
            put(v_z, even + mine, lane)
            sync()
            if wp.static(not modulated):
                if warp * 8 < hidden:
                    v_wh = beside_image(all_v, all_prior, 0, warp * 8, v_wh, lane)
            if warp == 0:
                v_bh = bias_sums16(all_v, 0, 0, v_bh, lane)
            v_w3 = square(even, all_encoded, row, column, v_w3, lane)
            if across < biased:
                v_biases = bias_sums(even, bias_row, 1, v_biases, lane)
            v_encoded = back(whole(v_z, even + ours, lane), weight3 + of_columns, v_encoded, lane)
            v_z = rounded(wp.cw_mul(v_encoded, widened(slope2)))
            put(v_z, odd + mine, lane)
            sync()
            v_w2 = square(odd, all_first, row, column, v_w2, lane)
            if across < biased:
                v_biases = bias_sums(odd, bias_row, 0, v_biases, lane)
            if wp.static(team > 1):
                x = get_features(all_x + ours_features, lane)
            z = first_layer(x, rows1, bias1, lane)  # again: quick, and takes no registers
            v_first = back(whole(v_z, odd + ours, lane), weight2 + of_columns, sums(), lane)
            v_z = rounded(wp.cw_mul(v_first, widened(silu_slope(z))))
            put(v_z, even + mine, lane)
            following = pixel + programs * pixels_of_block
            x = read_features(features, following, lane)  # the next, while these are finished
            v = rounded16(read_gradient(image, v_image, factor, following, lane))
            sync()
            if warp * 8 < hidden:
                v_w1 = beside_features(even, all_x, (warp >> 1) * 16, (warp & 1) * half_inputs, v_w1, lane)
            if member == 0:
                v_x = to_features(whole(v_z, even + ours, lane), weight1, feature_sums(), lane)
                write_features(v_x, v_features, unscaled, pixel, lane)
            sync()
            pixel = following
        out = partial[program]
        dim, channels = features.shape[1], image.shape[1]
        if warp * 8 < hidden:
            store_w1(v_w1, out, 0, hidden, dim, (warp >> 1) * 16, (warp & 1) * half_inputs, True, unscaled, lane)
        first = (dim + 1) * hidden
        store_square(v_w2, out, first, hidden, hidden, row, column, False, unscaled, lane)
        if across < biased:
            store_sums(v_biases, 0, out, first + hidden * hidden, hidden, bias_row, unscaled, lane)
        first += (hidden + 1) * hidden
        store_square(v_w3, out, first, hidden, hidden, row, column, False, unscaled, lane)
        if across < biased:
            store_sums(v_biases, 1, out, first + hidden * hidden, hidden, bias_row, unscaled, lane)
        first += (hidden + 1) * hidden
        if wp.static(modulated):
            store_square(v_wg, out, first, hidden, hidden, row, column, False, unscaled, lane)
            store_square(v_wb, out, first + hidden * hidden, hidden, hidden, row, column, False, unscaled, lane)
            if across < biased:
                store_sums(v_biases, 2, out, first + 2 * hidden * hidden, hidden, bias_row, unscaled, lane)
                store_sums(v_biases, 3, out, first + (2 * hidden + 1) * hidden, hidden, bias_row, unscaled, lane)
            first += 2 * (hidden + 1) * hidden
        if warp * 8 < hidden:
            store_wh(v_wh, out, first, channels, hidden, 0, warp * 8, False, unscaled, lane)
        if warp == 0:
            store_sums(v_bh, 0, out, first + channels * hidden, channels, 0, unscaled, lane)

    return adjoint
