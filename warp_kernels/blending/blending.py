"""Front-to-back alpha blending of C channels, the last D of them a second time with a second opacity.

Per pixel at offset d from a Gaussian's mean: z = U d with the conic's root U (see projection), σ = ½ |z|²,
α = min(ALPHA_MAX, o exp(-σ)), skipped where α < ALPHA_MIN; colour += α T f, T *= 1 - α, stopping before the Gaussian
that would bring T to TRANSMITTANCE_MIN. The second opacity runs through the same list with a transmittance of its own.

A warp tests 32 candidates at a time against its pixel block, one a lane, and walks the survivors by ballot. On the CPU
the binning was exact for the whole tile, so candidates are walked directly, each over the rows its ellipse reaches.
A pixel that has finished carries the sign bit in its transmittance.

Long lists are cut into segments that are blended side by side; see list_segments.
"""

import warp as wp

from warp_kernels.blending.blend_variant import BlendVariant
from warp_kernels.blending.list_segments import list_of_block
from warp_kernels.blending.pixel_ends import end_functions
from warp_kernels.blending.survivors import HEADER
from warp_kernels.constants import TRANSMITTANCE_MIN
from warp_kernels.machinery.lanes import lane_functions, warp_any
from warp_kernels.machinery.loading import made_once

BATCH = 32
"""Gaussians walked between two checks for unfinished pixels."""


@made_once
def blend_kernel(variant: BlendVariant) -> wp.Kernel:
    """The forward kernel, one block of threads a list or a segment of a long one.

    Args:
        variant: channels, opacities, precision and deal of pixels.

    Returns:
        The Warp kernel.
    """
    dtype, layout, dual, cuda = variant.dtype, variant.layout, variant.dual, variant.cuda
    C, D = variant.channels, max(variant.thermal_channels, 1)
    lanes, rows, columns, threads, pixels = layout.lanes, layout.rows, layout.columns, layout.threads, variant.pixels
    row_mask = rows - 1  # rows is a power of two: keeps the index provably non-negative, which vectorising needs
    tile_size, block_width, block_height = layout.tile_size, layout.block_width, layout.block_height
    blocks_x = layout.blocks_x
    first_thermal, batch, header = variant.first_thermal, BATCH, HEADER
    first_behind, first_behind_t = variant.first_behind, variant.first_behind_thermal
    zero, half, one, minus_one = dtype(0.0), dtype(0.5), dtype(1.0), dtype(-1.0)
    transmittance_min = dtype(TRANSMITTANCE_MIN)
    staged = variant.stages_features
    kinds, response, attenuate = variant.types, variant.response, lane_functions(dtype)[1]
    survivors, waiting = variant.records(staged=staged), variant.queue(backwards=False)
    pack_end, _ = end_functions(dtype)

    @wp.kernel(
        name=variant.name("blend"),
        enable_backward=False,
        module="unique",
        module_options=layout.module_options(widest_vectors=True),
        grid_stride=False,
        launch_bounds=max(layout.threads, 32),
    )
    def blend_tiles_kernel(
        first_block: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        means2d: wp.array(dtype=kinds.vec2),  # [images · N]
        packed_roots: wp.array(dtype=kinds.vec4),  # [images · N]
        extents: wp.array(dtype=kinds.vec2),  # [images · N]; read on the CPU alone
        opacities: wp.array(dtype=dtype),  # [images · N]
        thermal_opacities: wp.array(dtype=dtype),  # [images · N]; read where there are two opacities
        features: wp.array(dtype=kinds.vecA),  # [images · N]
        rest: wp.array(dtype=kinds.vecB),  # [images · N]; [0]: there are no other channels
        gaussian_ids: wp.array(dtype=wp.int32),  # [pairs]
        masks: wp.array(dtype=wp.uint8),  # [pairs]; read on CUDA alone
        tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
        segment: int,
        cuts: wp.array(dtype=wp.int32),  # [tiles + rows + 1]; [0]: no list is cut
        bits: int,
        # outputs
        render: wp.array2d(dtype=kinds.vecC),  # [images · height, width]
        transmittance: wp.array2d(dtype=dtype),  # [images · height, width]
        ends: wp.array2d(dtype=wp.int32),  # [images · height, width]
        alphas: wp.array2d(dtype=dtype),  # [images · height, width]; [0, 0]: not wanted
        thermal_render: wp.array2d(dtype=kinds.vecD),  # [images · height, width]; [0, 0]: one opacity
        thermal_transmittance: wp.array2d(dtype=dtype),  # [images · height, width]
        thermal_ends: wp.array2d(dtype=wp.int32),  # [images · height, width]
        thermal_alphas: wp.array2d(dtype=dtype),  # [images · height, width]; [0, 0]: not wanted
        states: wp.array3d(dtype=dtype),  # [rows, state_length, pixels of a tile]
    ):
        block, thread = wp.tid()
        block = block + first_block
        tile, first_pair, end, cut, to_row = list_of_block(block, tile_offsets, segment, cuts)
        if first_pair > end:
            return
        i = int(first_pair)
        is_first = first_pair == tile_offsets[tile]
        is_last = end == tile_offsets[tile + 1]
        warp = thread // lanes
        lane = thread % lanes
        image = tile // (tiles_x * tiles_y)
        in_image = tile % (tiles_x * tiles_y)
        block_x = (in_image % tiles_x) * tile_size + (warp % blocks_x) * block_width
        block_y = (in_image // tiles_x) * tile_size + (warp // blocks_x) * block_height

        # Pixels and means are seen from the middle of the block.
        middle_x, middle_y = response.middle_of(block_x, block_y, width, height)
        middle = kinds.vec2(dtype(middle_x), dtype(middle_y))
        x0 = half - dtype(middle_x - block_x)
        y0 = half - dtype(middle_y - block_y)
        PX = kinds.vecQ()
        PY = kinds.vecQ()
        for q in range(columns):
            PX[q] = x0 + dtype((lane + q * lanes) % block_width)
            PY[q] = y0 + dtype((lane + q * lanes) // block_width)
        T = kinds.vecP()
        Tt = kinds.vecP()
        last = kinds.vecPi()
        last_t = kinds.vecPi()
        # Transmittance at which a pixel stops; negative where a later segment goes on with it, whatever rounds here.
        stop_at = kinds.vecP()
        stop_at_t = kinds.vecP()
        acc = kinds.matCP()
        acc_t = kinds.matDP()
        for r in range(rows):
            for q in range(columns):
                p = r * columns + q
                inside = int(middle[0] + PX[q]) < width and int(middle[1] + PY[q]) + r < height
                T[p] = wp.where(inside, one, minus_one)
                Tt[p] = wp.where(inside, one, minus_one)
                last[p] = -1
                last_t[p] = -1
                stop_at[p] = transmittance_min
                stop_at_t[p] = transmittance_min
                if cut and inside:
                    place = p * threads + thread
                    for boundary in range(tile_offsets[tile] // segment + 1, first_pair // segment + 1):
                        T[p] = T[p] * states[boundary + to_row, 0, place]
                        if wp.static(dual):
                            Tt[p] = Tt[p] * states[boundary + to_row, 1, place]
                    if not is_last:
                        if T[p] * states[end // segment + to_row, 0, place] > transmittance_min:
                            stop_at[p] = minus_one
                        if wp.static(dual):
                            if Tt[p] * states[end // segment + to_row, 1, place] > transmittance_min:
                                stop_at_t[p] = minus_one
                    if T[p] <= transmittance_min:
                        T[p] = minus_one
                    if wp.static(dual):
                        if Tt[p] <= transmittance_min:
                            Tt[p] = minus_one

        # The next up to 32 to be walked; on CUDA each lane has one
        count = wp.min(batch, end - i)
        place = int(0)
        g = int(0)
        taken = int(0)
        put = int(0)
        mask = int(0)
        parts = int(0)
        queue = wp.uint64(0)
        address = wp.uint64(0)
        if wp.static(cuda):
            queue = waiting.queue_of_warp(warp)
            address = survivors.records_of_warp(warp)
            parts = waiting.block_parts(warp)
            mask = waiting.mask_of(i + lane, end, masks)
            put, i, mask = waiting.refill(queue, lane, parts, taken, put, i, mask, end, masks)
            count, place, g = waiting.take(queue, lane, taken, put, gaussian_ids)
        while count > 0:
            alive = int(0)
            for p in range(pixels):
                alive = alive | wp.where(T[p] > zero, 1, 0)
                if wp.static(dual):
                    alive = alive | wp.where(Tt[p] > zero, 1, 0)
            if warp_any(alive) == 0:
                break

            walked = count
            if wp.static(cuda):
                survivors.store(
                    address, lane, count, place, g, middle,
                    means2d, packed_roots, opacities, thermal_opacities, features, rest,
                )  # fmt: skip
                taken += count
                put, i, mask = waiting.refill(queue, lane, parts, taken, put, i, mask, end, masks)
                count, place, g = waiting.take(queue, lane, taken, put, gaussian_ids)

            for k in range(walked):
                pair = i + k
                gaussian = int(0)
                m = kinds.vec2()
                U = kinds.vec3()
                o = zero
                ot = zero
                f = kinds.vecC()
                row_first = int(0)
                row_end = int(1)
                if wp.static(cuda):
                    entry = survivors.get(address, k)
                    m = kinds.vec2(entry[0], entry[1])
                    U = kinds.vec3(entry[2], entry[3], entry[4])
                    o = entry[5]
                    ot = entry[6]
                    pair = survivors.integer(entry[7])
                    if wp.static(staged):
                        for c in range(C):
                            f[c] = entry[header + c]
                    else:
                        f = survivors.features_of(survivors.integer(entry[8]), features, rest)
                else:
                    gaussian = gaussian_ids[pair]
                    root = packed_roots[gaussian]
                    m = response.from_middle(means2d[gaussian], root, middle)
                    U = response.in_units(root)
                    o = opacities[gaussian]
                    ot = thermal_opacities[gaussian]
                    f = survivors.features_of(gaussian, features, rest)
                    row_first, row_end = response.row_range(m, extents[gaussian], y0, rows)
                for row in range(row_first, row_end):
                    offset = (row & row_mask) * columns
                    weight = kinds.vecQ()
                    weight_t = kinds.vecQ()
                    for q in range(columns):
                        zx, zy = response.whiten(U, m[0] - PX[q], m[1] - (PY[q] + dtype(row)))
                        seen = response.visibility(zx, zy)
                        a = response.alpha(o, seen)
                        t = T[offset + q]
                        next_t = attenuate(t, a)
                        stop = next_t <= stop_at[offset + q]
                        w = wp.where(stop, zero, a * t)
                        T[offset + q] = wp.where(stop, -wp.abs(t), next_t)
                        last[offset + q] = wp.where(w > zero, pair, last[offset + q])
                        weight[q] = w
                        if wp.static(dual):
                            a = response.alpha(ot, seen)
                            t = Tt[offset + q]
                            next_t = attenuate(t, a)
                            stop = next_t <= stop_at_t[offset + q]
                            w = wp.where(stop, zero, a * t)
                            Tt[offset + q] = wp.where(stop, -wp.abs(t), next_t)
                            last_t[offset + q] = wp.where(w > zero, pair, last_t[offset + q])
                            weight_t[q] = w
                    for c in range(C):
                        for q in range(columns):
                            acc[c, offset + q] += weight[q] * f[c]
                    if wp.static(dual):
                        for c in range(D):
                            for q in range(columns):
                                acc_t[c, offset + q] += weight_t[q] * f[first_thermal + c]
            if wp.static(not cuda):
                i += walked
                count = wp.min(batch, end - i)

        for r in range(rows):
            for q in range(columns):
                p = r * columns + q
                x = int(middle[0] + PX[q])
                y = int(middle[1] + PY[q]) + r
                place = p * threads + thread
                if x < width and y < height:
                    line = image * height + y
                    if is_first:
                        v = kinds.vecC()
                        for c in range(C):
                            v[c] = acc[c, p]
                        render[line, x] = v
                    else:
                        for c in range(C):
                            states[first_pair // segment + to_row, first_behind + c, place] = acc[c, p]
                    # Of a cut list one segment alone: the one that the pixel enters and may stop in.
                    if T[p] != minus_one and stop_at[p] > zero:
                        alpha = one - wp.abs(T[p])
                        last_pair = wp.where(last[p] < 0 and not is_first, first_pair - 1, last[p])
                        transmittance[line, x] = wp.abs(T[p])
                        ends[line, x] = pack_end(last_pair, wp.abs(T[p]), alpha, bits)
                        if alphas.shape[0] > 0:
                            alphas[line, x] = alpha
                    if wp.static(dual):
                        if is_first:
                            vt = kinds.vecD()
                            for c in range(D):
                                vt[c] = acc_t[c, p]
                            thermal_render[line, x] = vt
                        else:
                            for c in range(D):
                                states[first_pair // segment + to_row, first_behind_t + c, place] = acc_t[c, p]
                        if Tt[p] != minus_one and stop_at_t[p] > zero:
                            alpha = one - wp.abs(Tt[p])
                            last_pair = wp.where(last_t[p] < 0 and not is_first, first_pair - 1, last_t[p])
                            thermal_transmittance[line, x] = wp.abs(Tt[p])
                            thermal_ends[line, x] = pack_end(last_pair, wp.abs(Tt[p]), alpha, bits)
                            if thermal_alphas.shape[0] > 0:
                                thermal_alphas[line, x] = alpha

    return blend_tiles_kernel
