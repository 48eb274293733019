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

from warp_kernels.blending.alpha import alpha_functions
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.blending.list_segments import list_of_block
from warp_kernels.blending.survivors import HEADER, queue_functions, record_functions, stages_features
from warp_kernels.constants import TRANSMITTANCE_MIN
from warp_kernels.machinery.lanes import lane_functions, warp_any
from warp_kernels.machinery.loading import made_once

BATCH = 32
"""Gaussians walked between two checks for unfinished pixels."""


@made_once
def blend_kernel(
    channels: int,
    thermal_channels: int,
    dtype: type,
    layout: BlendLayout,
    only_transmittance: bool = False,
    first_channels: int | None = None,
) -> wp.Kernel:
    """The forward kernel, one block of threads a list or a segment of a long one.

    Args:
        channels: C, channels blended with the first opacity.
        thermal_channels: D <= C; the last D channels are blended with the second opacity too. 0: one opacity.
        dtype: ``wp.float32`` or ``wp.float64``.
        layout: deal of pixels to lanes.
        only_transmittance: find what segments of long lists let through (T of a pixel that begins at 1; 0 where the
            pixel would stop) instead of blending.
        first_channels: of the C, those that lie in an array of their own, in front of the others; None: all.

    Returns:
        The Warp kernel.
    """
    C, D = channels, max(thermal_channels, 1)
    A = C if first_channels is None else first_channels
    colors, colors_t = (0, 0) if only_transmittance else (C, D)
    dual = thermal_channels > 0
    lanes, rows, columns = layout.lanes, layout.rows, layout.columns
    cuda = lanes > 1
    threads, pixels = layout.threads, rows * columns
    row_mask = rows - 1  # rows is a power of two: keeps the index provably non-negative, which vectorising needs
    vec2, vec3, vec4 = (wp.types.vector(count, dtype) for count in (2, 3, 4))
    vecC, vecD = wp.types.vector(C, dtype), wp.types.vector(D, dtype)
    vecA, vecB = wp.types.vector(A, dtype), wp.types.vector(max(C - A, 1), dtype)
    vecQ = wp.types.vector(columns, dtype)
    vecP, vecPi = wp.types.vector(pixels, dtype), wp.types.vector(pixels, wp.int32)
    matCP, matDP = wp.types.matrix((C, pixels), dtype), wp.types.matrix((D, pixels), dtype)
    first_behind = 2 if dual else 1
    first_behind_t = first_behind + C
    middle_of, from_middle, in_units, whiten, visibility, alpha, row_range = alpha_functions(dtype, layout)
    _, attenuate, _ = lane_functions(dtype)
    zero, half, one, minus_one = dtype(0.0), dtype(0.5), dtype(1.0), dtype(-1.0)
    transmittance_min = dtype(TRANSMITTANCE_MIN)
    tile_size, block_width, block_height = layout.tile_size, layout.block_width, layout.block_height
    blocks_x = layout.blocks_x
    batch = BATCH
    first_thermal = C - D
    staged, header = stages_features(channels, dtype, layout) and not only_transmittance, HEADER
    features_of, records_of_warp, store, get, integer = record_functions(C, A, staged, dual, dtype, layout)
    queue_of_warp, block_parts, mask_of, refill, take = queue_functions(layout, False)
    name = f"blend_{C}_{thermal_channels}_{dtype.__name__}_{layout.tag}" + (f"_{A}" if A < C else "")

    @wp.kernel(
        name=name + "_transmittance" * only_transmittance,
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
        means2d: wp.array(dtype=vec2),
        packed_roots: wp.array(dtype=vec4),
        extents: wp.array(dtype=vec2),
        opacities: wp.array(dtype=dtype),
        thermal_opacities: wp.array(dtype=dtype),
        features: wp.array(dtype=vecA),
        rest: wp.array(dtype=vecB),
        gaussian_ids: wp.array(dtype=wp.int32),
        masks: wp.array(dtype=wp.uint8),
        tile_offsets: wp.array(dtype=wp.int32),
        segment: int,
        # outputs
        render: wp.array2d(dtype=vecC),
        transmittance: wp.array2d(dtype=dtype),
        last_pairs: wp.array2d(dtype=wp.int32),
        alphas: wp.array2d(dtype=dtype),
        thermal_render: wp.array2d(dtype=vecD),
        thermal_transmittance: wp.array2d(dtype=dtype),
        thermal_last_pairs: wp.array2d(dtype=wp.int32),
        thermal_alphas: wp.array2d(dtype=dtype),
        states: wp.array3d(dtype=dtype),
    ):
        block, thread = wp.tid()
        block = block + first_block
        tile, first_pair, end, cut = list_of_block(block, tile_offsets, segment)
        if first_pair > end:
            return
        i = int(first_pair)
        is_first = first_pair == tile_offsets[tile]
        is_last = end == tile_offsets[tile + 1]
        if wp.static(only_transmittance):
            if not cut or is_last:
                return
        warp = thread // lanes
        lane = thread % lanes
        image = tile // (tiles_x * tiles_y)
        in_image = tile % (tiles_x * tiles_y)
        block_x = (in_image % tiles_x) * tile_size + (warp % blocks_x) * block_width
        block_y = (in_image // tiles_x) * tile_size + (warp // blocks_x) * block_height

        # Pixels and means are seen from the middle of the block.
        middle_x, middle_y = middle_of(block_x, block_y, width, height)
        middle = vec2(dtype(middle_x), dtype(middle_y))
        x0 = half - dtype(middle_x - block_x)
        y0 = half - dtype(middle_y - block_y)
        PX = vecQ()
        PY = vecQ()
        for q in range(columns):
            PX[q] = x0 + dtype((lane + q * lanes) % block_width)
            PY[q] = y0 + dtype((lane + q * lanes) // block_width)
        T = vecP()
        Tt = vecP()
        last = vecPi()
        last_t = vecPi()
        # Transmittance at which a pixel stops; negative where a later segment goes on with it, whatever rounds here.
        stop_at = vecP()
        stop_at_t = vecP()
        acc = matCP()
        acc_t = matDP()
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
                if wp.static(not only_transmittance):
                    if cut and inside:
                        place = p * threads + thread
                        for boundary in range(tile_offsets[tile] // segment + 1, first_pair // segment + 1):
                            T[p] = T[p] * states[boundary, 0, place]
                            if wp.static(dual):
                                Tt[p] = Tt[p] * states[boundary, 1, place]
                        if not is_last:
                            if T[p] * states[end // segment, 0, place] > transmittance_min:
                                stop_at[p] = minus_one
                            if wp.static(dual):
                                if Tt[p] * states[end // segment, 1, place] > transmittance_min:
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
            queue = queue_of_warp(warp)
            address = records_of_warp(warp)
            parts = block_parts(warp)
            mask = mask_of(i + lane, end, masks)
            put, i, mask = refill(queue, lane, parts, taken, put, i, mask, end, masks)
            count, place, g = take(queue, lane, taken, put, gaussian_ids)
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
                store(
                    address, lane, count, place, g, middle,
                    means2d, packed_roots, opacities, thermal_opacities, features, rest,
                )  # fmt: skip
                taken += count
                put, i, mask = refill(queue, lane, parts, taken, put, i, mask, end, masks)
                count, place, g = take(queue, lane, taken, put, gaussian_ids)

            for k in range(walked):
                pair = i + k
                gaussian = int(0)
                m = vec2()
                U = vec3()
                o = zero
                ot = zero
                f = vecC()
                row_first = int(0)
                row_end = int(1)
                if wp.static(cuda):
                    entry = get(address, k)
                    m = vec2(entry[0], entry[1])
                    U = vec3(entry[2], entry[3], entry[4])
                    o = entry[5]
                    ot = entry[6]
                    pair = integer(entry[7])
                    if wp.static(staged):
                        for c in range(C):
                            f[c] = entry[header + c]
                    elif wp.static(not only_transmittance):
                        f = features_of(integer(entry[8]), features, rest)
                else:
                    gaussian = gaussian_ids[pair]
                    root = packed_roots[gaussian]
                    m = from_middle(means2d[gaussian], root, middle)
                    U = in_units(root)
                    o = opacities[gaussian]
                    ot = thermal_opacities[gaussian]
                    if wp.static(not only_transmittance):
                        f = features_of(gaussian, features, rest)
                    row_first, row_end = row_range(m, extents[gaussian], y0, rows)
                for row in range(row_first, row_end):
                    offset = (row & row_mask) * columns
                    weight = vecQ()
                    weight_t = vecQ()
                    for q in range(columns):
                        zx, zy = whiten(U, m[0] - PX[q], m[1] - (PY[q] + dtype(row)))
                        seen = visibility(zx, zy)
                        a = alpha(o, seen)
                        t = T[offset + q]
                        next_t = attenuate(t, a)
                        stop = next_t <= stop_at[offset + q]
                        w = wp.where(stop, zero, a * t)
                        T[offset + q] = wp.where(stop, -wp.abs(t), next_t)
                        last[offset + q] = wp.where(w > zero, pair, last[offset + q])
                        weight[q] = w
                        if wp.static(dual):
                            a = alpha(ot, seen)
                            t = Tt[offset + q]
                            next_t = attenuate(t, a)
                            stop = next_t <= stop_at_t[offset + q]
                            w = wp.where(stop, zero, a * t)
                            Tt[offset + q] = wp.where(stop, -wp.abs(t), next_t)
                            last_t[offset + q] = wp.where(w > zero, pair, last_t[offset + q])
                            weight_t[q] = w
                    for c in range(colors):
                        for q in range(columns):
                            acc[c, offset + q] += weight[q] * f[c]
                    if wp.static(dual):
                        for c in range(colors_t):
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
                if wp.static(only_transmittance):
                    states[end // segment, 0, place] = wp.max(T[p], zero)
                    if wp.static(dual):
                        states[end // segment, 1, place] = wp.max(Tt[p], zero)
                elif x < width and y < height:
                    line = image * height + y
                    if is_first:
                        v = vecC()
                        for c in range(C):
                            v[c] = acc[c, p]
                        render[line, x] = v
                    else:
                        for c in range(C):
                            states[first_pair // segment, first_behind + c, place] = acc[c, p]
                    # Of a cut list one segment alone: the one that the pixel enters and may stop in.
                    if T[p] != minus_one and stop_at[p] > zero:
                        transmittance[line, x] = wp.abs(T[p])
                        last_pairs[line, x] = wp.where(last[p] < 0 and not is_first, first_pair - 1, last[p])
                        if alphas.shape[0] > 0:
                            alphas[line, x] = one - wp.abs(T[p])
                    if wp.static(dual):
                        if is_first:
                            vt = vecD()
                            for c in range(D):
                                vt[c] = acc_t[c, p]
                            thermal_render[line, x] = vt
                        else:
                            for c in range(D):
                                states[first_pair // segment, first_behind_t + c, place] = acc_t[c, p]
                        if Tt[p] != minus_one and stop_at_t[p] > zero:
                            thermal_transmittance[line, x] = wp.abs(Tt[p])
                            thermal_last_pairs[line, x] = wp.where(
                                last_t[p] < 0 and not is_first, first_pair - 1, last_t[p]
                            )
                            if thermal_alphas.shape[0] > 0:
                                thermal_alphas[line, x] = one - wp.abs(Tt[p])

    return blend_tiles_kernel
