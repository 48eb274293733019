"""Adjoint of the blending, back to front, written by hand: Warp's generated adjoint of a dynamic loop is wrong.

Walking a pixel's list backwards, T is recovered by division (so that it does not drift over thousands of layers, faint
ones add an increment), and the colour behind the current Gaussian enters only through one number per pixel and opacity,
S = Σ_behind w (f · dL/dcolour), seeded by the final transmittance's gradient: dL/dα = T (f · dL/dcolour) - S / (1 - α).
Segments of long lists are walked from the states that the forward pass left; see list_segments.

Each warp sums a Gaussian's gradient over its pixels into one record; see gradient_records. Those to mean and conic are
summed as moments of z, the offset in the Gaussian's standard deviations, in which nothing cancels.
"""

import warp as wp

from warp_kernels.blending.blend_arguments import SortedPairs, TileGrid
from warp_kernels.blending.blend_variant import BlendVariant
from warp_kernels.blending.gradient_records import feature_offset, kept_channels, ranges_apart, record_length
from warp_kernels.blending.list_segments import part_of_block
from warp_kernels.blending.pixel_ends import end_functions
from warp_kernels.constants import ALPHA_MAX
from warp_kernels.machinery.lane_sums import accumulate_snippet, column_sums_snippet
from warp_kernels.machinery.lanes import lane_functions, warp_any, warp_max
from warp_kernels.machinery.loading import made_once

FEW_CHANNELS = 16
"""Channels up to which a thread of one pixel does with 64 registers."""


@made_once
def blend_adjoint_kernel(variant: BlendVariant, absgrad: bool, by_slot: bool) -> wp.Kernel:
    """The adjoint kernel, one block of threads a list or a segment of a long one.

    Args:
        absgrad: also sum the absolute values of each pixel's mean2d gradient.
        by_slot: store one record per pair and warp instead of adding atomically per Gaussian; on the CPU always.
    """
    dtype, layout, dual, cuda = variant.dtype, variant.layout, variant.dual, variant.cuda
    C, D, A = variant.channels, max(variant.thermal_channels, 1), variant.first_channels
    lanes, rows, columns, threads = layout.lanes, layout.rows, layout.columns, layout.threads
    row_mask = rows - 1  # as in blending
    warps, first_thermal = layout.warps, variant.first_thermal
    first_behind, first_behind_t = variant.first_behind, variant.first_behind_thermal
    zero, half, one, alpha_max = dtype(0.0), dtype(0.5), dtype(1.0), dtype(ALPHA_MAX)
    kinds, PixelEnds, response, reciprocal = (
        variant.types,
        variant.types.PixelEnds,
        variant.response,
        lane_functions(dtype)[2],
    )
    blocks, walking = variant.blocks, variant.walk(staged=variant.stages_features, backwards=True)
    _, unpack_end = end_functions(dtype)
    length = record_length(C, variant.thermal_channels, absgrad)
    first_feature = feature_offset(variant.thermal_channels)
    first_feature_t = first_feature + C - D
    summed = wp.types.vector(length, dtype)
    record = wp.types.vector(length - C + sum(kept_channels(C, A, by_slot)), dtype)
    records_type, rows_a, rows_b, rows_2, rows_3, rows_1 = (
        wp.array(dtype=kind) for kind in (record, kinds.vecA, kinds.vecB, kinds.vec2, kinds.vec3, dtype)
    )
    # A lane sums a Gaussian's record over its pixels: on CUDA in registers, on the CPU, where a vector holds a row of
    # pixels, column by column, since a sum over a vector costs more than all else that is done with it.
    spread = 0 if cuda else 1
    matLS = wp.types.matrix((length, 1 if cuda else columns), dtype)

    @wp.func
    def restored(behind: dtype, a: dtype, ra: dtype):
        """T before a layer from T behind it, T / (1 - a); for a faint layer by an increment, which hardly rounds."""
        return wp.where(a < half, behind + behind * (a * ra), behind * ra)

    @wp.func
    def end_of_pixel(pixels: PixelEnds, line: int, x: int, bits: int):
        """The last pair and the light that is left."""
        alpha = zero
        if pixels.alphas.shape[0] > 0:
            alpha = pixels.alphas[line, x]
        last_pair, light = unpack_end(pixels.ends[line, x], alpha, bits)
        if pixels.alphas.shape[0] == 0:
            light = pixels.transmittance[line, x]
        return last_pair, light

    apart = ranges_apart(C, A, variant.thermal_channels, by_slot, absgrad)

    @wp.func_native(accumulate_snippet(length, dtype, apart=apart))
    def accumulate(
        dst: records_type, means2d: rows_2, roots: rows_3, opacities: rows_1, thermal_opacities: rows_1,
        features: rows_a, rest: rows_b, index: int, lane: int, v: summed,
    ): ...  # fmt: skip

    @wp.func_native(column_sums_snippet(length, columns, dtype) if by_slot else "")
    def store_column_sums(out: records_type, index: int, m: matLS): ...

    # Four blocks of eight warps a multiprocessor: left alone, the compiler takes fewer registers than that for three
    # channels and spills, and more for eleven.
    four_blocks = layout.warps == 8 and C <= FEW_CHANNELS and dtype is wp.float32 and cuda
    bounds = (layout.threads, 4) if four_blocks else max(layout.threads, 32)

    @wp.kernel(
        name=variant.name("blend_adjoint") + "_abs" * absgrad + "_slots" * by_slot,
        enable_backward=False,
        module="unique",
        module_options=layout.module_options(widest_vectors=False),
        grid_stride=False,
        launch_bounds=bounds,
    )
    def blend_tiles_adjoint_kernel(
        first_block: int,
        grid: TileGrid,
        splats: kinds.Splats,
        pairs: SortedPairs,
        slots: wp.array(dtype=wp.int32),  # [pairs]; read with by_slot
        states: wp.array3d(dtype=dtype),  # [rows, state_length, pixels of a tile]
        bits: int,
        pixel_ends: PixelEnds,
        thermal_ends: PixelEnds,
        v_render: wp.array2d(dtype=kinds.vecA),  # [images · height, width]; [0, 0]: zeros, as in those below
        v_render_rest: wp.array2d(dtype=kinds.vecB),  # [images · height, width]
        sign: dtype,
        v_transmittance: wp.array2d(dtype=dtype),  # [images · height, width]
        v_thermal_render: wp.array2d(dtype=kinds.vecD),  # [images · height, width]
        v_thermal_transmittance: wp.array2d(dtype=dtype),  # [images · height, width]
        # outputs
        records: records_type,  # [pairs · warps] with by_slot, [images · N] without; [0] with sums_apart
        first_moments: rows_2,  # [images · N]; these four are written with sums_apart alone
        second_moments: rows_3,  # [images · N]
        v_opacities: rows_1,  # [images · N]
        v_thermal_opacities: rows_1,  # [images · N]
        v_features: rows_a,  # [images · N]
        v_rest: rows_b,  # [images · N]; [0]: there are no other channels
    ):
        block, thread = wp.tid()
        part_of_list = part_of_block(block + first_block, pairs)
        begin = part_of_list.first
        end = part_of_list.end
        if begin >= end:
            return
        warp = thread // lanes
        lane = thread % lanes
        line_0 = part_of_list.tile // (grid.tiles_x * grid.tiles_y) * grid.height
        block_x, block_y = blocks.corner_of(part_of_list.tile, warp, grid)
        # Pixels and means are seen from the middle of the block.
        middle_x, middle_y = blocks.middle_of(block_x, block_y, grid)
        middle = kinds.vec2(dtype(middle_x), dtype(middle_y))
        PX, PY = blocks.centres(lane, middle_x - block_x, middle_y - block_y)
        T = kinds.vecP()
        Tt = kinds.vecP()
        S = kinds.vecP()
        St = kinds.vecP()
        last = kinds.vecPi()
        last_t = kinds.vecPi()
        v_pixel = kinds.matCP()
        v_pixel_t = kinds.matDP()
        newest = int(-1)
        for r in range(rows):
            for q in range(columns):
                p = r * columns + q
                x = int(middle[0] + PX[q])
                y = int(middle[1] + PY[q]) + r
                T[p] = one
                Tt[p] = one
                last[p] = -1
                last_t[p] = -1
                if x < grid.width and y < grid.height:
                    line = line_0 + y
                    last_pair, light = end_of_pixel(pixel_ends, line, x, bits)
                    T[p] = light
                    # gradients that are not given are zero
                    if v_transmittance.shape[0] > 0:
                        S[p] = sign * v_transmittance[line, x] * T[p]
                    last[p] = last_pair
                    newest = wp.max(newest, last[p])
                    if v_render.shape[0] > 0:
                        v = v_render[line, x]
                        for c in range(A):
                            v_pixel[c, p] = v[c]
                    if wp.static(A < C):
                        if v_render_rest.shape[0] > 0:
                            v_more = v_render_rest[line, x]
                            for c in range(wp.static(C - A)):
                                v_pixel[A + c, p] = v_more[c]
                    place = p * threads + thread
                    # where the pixel was not finished at the boundary, it left a state there
                    if last[p] >= end:
                        T[p] = states[end // pairs.segment + part_of_list.to_row, 0, place]
                        for c in range(C):
                            S[p] += (
                                states[end // pairs.segment + part_of_list.to_row, first_behind + c, place]
                                * v_pixel[c, p]
                            )
                    if wp.static(dual):
                        last_pair, light = end_of_pixel(thermal_ends, line, x, bits)
                        Tt[p] = light
                        if v_thermal_transmittance.shape[0] > 0:
                            St[p] = sign * v_thermal_transmittance[line, x] * Tt[p]
                        last_t[p] = last_pair
                        newest = wp.max(newest, last_t[p])
                        if v_thermal_render.shape[0] > 0:
                            vt = v_thermal_render[line, x]
                            for c in range(D):
                                v_pixel_t[c, p] = vt[c]
                        if last_t[p] >= end:
                            Tt[p] = states[end // pairs.segment + part_of_list.to_row, 1, place]
                            for c in range(D):
                                St[p] += (
                                    states[end // pairs.segment + part_of_list.to_row, first_behind_t + c, place]
                                    * v_pixel_t[c, p]
                                )

        i = wp.min(int(warp_max(newest)), end - 1)
        walk = walking.begin(warp, lane, i, begin, pairs)
        while walk.count > 0:
            count = int(walk.count)
            candidate = int(walk.candidate)
            walk = walking.go_on(walk, lane, middle, splats, pairs)
            for k in range(count):
                pair, gaussian, m, U, o, ot, f, row_first, row_end = walking.gaussian(
                    walk, candidate - k, k, middle, PY[0], splats, pairs
                )
                part = matLS()
                hits = int(0)
                for row in range(row_first, row_end):
                    offset = (row & row_mask) * columns
                    # f · dL/dcolour of every pixel of the row
                    dot = kinds.vecQ()
                    dot_t = kinds.vecQ()
                    for c in range(C):
                        for q in range(columns):
                            dot[q] += f[c] * v_pixel[c, offset + q]
                    if wp.static(dual):
                        for c in range(D):
                            for q in range(columns):
                                dot_t[q] += f[first_thermal + c] * v_pixel_t[c, offset + q]
                    weight = kinds.vecQ()
                    weight_t = kinds.vecQ()
                    for q in range(columns):
                        zx, zy = response.whiten(U, m[0] - PX[q], m[1] - (PY[q] + dtype(row)))
                        seen = response.visibility(zx, zy)
                        a = response.alpha(o, seen)
                        a = wp.where(pair > last[offset + q], zero, a)
                        hits = hits | wp.where(a > zero, 1, 0)
                        ra = reciprocal(one - a)
                        t = restored(T[offset + q], a, ra)
                        T[offset + q] = t
                        w = a * t
                        weight[q] = w
                        s = S[offset + q]
                        v_alpha = t * dot[q] - s * ra
                        S[offset + q] = s + w * dot[q]
                        # no gradient where alpha was clamped or the Gaussian not drawn
                        v_alpha = wp.where(a >= alpha_max or a == zero, zero, v_alpha)
                        v_power = v_alpha * a
                        part[5, q * spread] += v_alpha * seen
                        if wp.static(dual):
                            a = response.alpha(ot, seen)
                            a = wp.where(pair > last_t[offset + q], zero, a)
                            hits = hits | wp.where(a > zero, 1, 0)
                            ra = reciprocal(one - a)
                            t = restored(Tt[offset + q], a, ra)
                            Tt[offset + q] = t
                            w = a * t
                            weight_t[q] = w
                            s = St[offset + q]
                            v_alpha = t * dot_t[q] - s * ra
                            St[offset + q] = s + w * dot_t[q]
                            v_alpha = wp.where(a >= alpha_max or a == zero, zero, v_alpha)
                            v_power = v_power + v_alpha * a
                            part[6, q * spread] += v_alpha * seen
                        px = v_power * zx
                        py = v_power * zy
                        part[0, q * spread] += px
                        part[1, q * spread] += py
                        part[2, q * spread] += px * zx
                        part[3, q * spread] += px * zy
                        part[4, q * spread] += py * zy
                        if wp.static(absgrad):
                            part[length - 2, q * spread] += wp.abs(U[0] * px)
                            part[length - 1, q * spread] += wp.abs(U[0] * U[1] * px + U[2] * py)
                    for c in range(C):
                        for q in range(columns):
                            part[first_feature + c, q * spread] += weight[q] * v_pixel[c, offset + q]
                    if wp.static(dual):
                        for c in range(D):
                            for q in range(columns):
                                part[first_feature_t + c, q * spread] += weight_t[q] * v_pixel_t[c, offset + q]
                if warp_any(hits) != 0:
                    destination = gaussian
                    if wp.static(by_slot):
                        destination = slots[pair] * warps + warp
                    if wp.static(cuda):
                        G = summed()
                        for k in range(length):
                            G[k] = part[k, 0]
                        accumulate(
                            records, first_moments, second_moments, v_opacities, v_thermal_opacities,
                            v_features, v_rest, destination, lane, G,
                        )  # fmt: skip
                    else:
                        store_column_sums(records, destination, part)

    return blend_tiles_adjoint_kernel
