"""Adjoint of the blending, back to front, written by hand: Warp's generated adjoint of a dynamic loop is wrong.

Walking a pixel's list backwards, T is recovered by division (so that it does not drift over thousands of layers, faint
ones add an increment), and the colour behind the current Gaussian enters only through one number per pixel and opacity,
S = Σ_behind w (f · dL/dcolour), seeded by the final transmittance's gradient: dL/dα = T (f · dL/dcolour) - S / (1 - α).
Segments of long lists are walked from the states that the forward pass left; see list_segments.

Each warp sums a Gaussian's gradient over its pixels into one record; see gradient_records. Those to mean and conic are
summed as moments of z, the offset in the Gaussian's standard deviations, in which nothing cancels.
"""

import warp as wp

from warp_kernels.blending.alpha import alpha_functions
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.blending.blending import BATCH
from warp_kernels.blending.gradient_records import feature_offset, kept_channels, ranges_apart, record_length
from warp_kernels.blending.list_segments import list_of_block
from warp_kernels.blending.survivors import HEADER, queue_functions, record_functions, stages_features
from warp_kernels.constants import ALPHA_MAX
from warp_kernels.machinery.lane_sums import accumulate_snippet, column_sums_snippet
from warp_kernels.machinery.lanes import lane_functions, warp_any, warp_max
from warp_kernels.machinery.loading import made_once

FEW_CHANNELS = 16
"""Channels up to which a thread of one pixel does with 64 registers."""


@made_once
def blend_adjoint_kernel(
    channels: int,
    thermal_channels: int,
    dtype: type,
    layout: BlendLayout,
    absgrad: bool,
    by_slot: bool,
    first_channels: int | None = None,
) -> wp.Kernel:
    """The adjoint kernel, one block of threads a list or a segment of a long one.

    Args:
        channels: C, channels blended with the first opacity.
        thermal_channels: D <= C; the last D channels were blended with the second opacity too. 0: one opacity.
        dtype: ``wp.float32`` or ``wp.float64``.
        layout: deal of pixels to lanes.
        absgrad: also sum the absolute values of each pixel's mean2d gradient.
        by_slot: store one record a pair and warp instead of adding atomically per Gaussian; on the CPU always.
        first_channels: of the C, those that lie apart from the others, as do their gradients and image; None: all.

    Returns:
        The Warp kernel.
    """
    C, D = channels, max(thermal_channels, 1)
    A = C if first_channels is None else first_channels
    lanes, rows, columns = layout.lanes, layout.rows, layout.columns
    dual, cuda = thermal_channels > 0, lanes > 1
    threads, pixels, row_mask = layout.threads, rows * columns, rows - 1
    length = record_length(channels, thermal_channels, absgrad)
    first_feature = feature_offset(thermal_channels)
    vec2, vec3, vec4 = (wp.types.vector(count, dtype) for count in (2, 3, 4))
    vecC, vecD = wp.types.vector(C, dtype), wp.types.vector(D, dtype)
    vecA, vecB = wp.types.vector(A, dtype), wp.types.vector(max(C - A, 1), dtype)
    vecQ = wp.types.vector(columns, dtype)
    vecP, vecPi = wp.types.vector(pixels, dtype), wp.types.vector(pixels, wp.int32)
    matCP, matDP = wp.types.matrix((C, pixels), dtype), wp.types.matrix((D, pixels), dtype)
    summed = wp.types.vector(length, dtype)
    record = wp.types.vector(length - C + sum(kept_channels(C, A, by_slot)), dtype)
    records_type, rowsA, rowsB = (wp.array(dtype=kind) for kind in (record, vecA, vecB))
    # A lane sums a Gaussian's record over its pixels: on CUDA in registers, on the CPU, where a vector holds a row of
    # pixels, column by column, since a sum over a vector costs more than all else that is done with it.
    spread = 0 if cuda else 1
    matLS = wp.types.matrix((length, 1 if cuda else columns), dtype)
    first_feature_t = first_feature + C - D
    first_behind = 2 if dual else 1
    first_behind_t = first_behind + C
    middle_of, from_middle, in_units, whiten, visibility, alpha, row_range = alpha_functions(dtype, layout)
    _, _, reciprocal = lane_functions(dtype)
    zero, half, one, alpha_max = dtype(0.0), dtype(0.5), dtype(1.0), dtype(ALPHA_MAX)
    tile_size, block_width, block_height = layout.tile_size, layout.block_width, layout.block_height
    blocks_x, warps = layout.blocks_x, layout.warps
    batch, first_thermal = BATCH, C - D
    staged, header = stages_features(channels, dtype, layout), HEADER
    features_of, records_of_warp, store, get, integer = record_functions(C, A, staged, dual, dtype, layout)
    queue_of_warp, block_parts, mask_of, refill, take = queue_functions(layout, True)

    @wp.func
    def restored(behind: dtype, a: dtype, ra: dtype):
        """T before a layer from T behind it, T / (1 - a); for a faint layer by an increment, which hardly rounds."""
        return wp.where(a < half, behind + behind * (a * ra), behind * ra)

    @wp.func_native(accumulate_snippet(length, dtype, apart=ranges_apart(C, A, first_feature, by_slot)))
    def accumulate(dst: records_type, features: rowsA, rest: rowsB, index: int, lane: int, v: summed): ...

    @wp.func_native(column_sums_snippet(length, columns, dtype) if by_slot else "")
    def store_column_sums(out: records_type, index: int, m: matLS): ...

    # Four blocks of eight warps a multiprocessor: left alone, the compiler takes fewer registers than that for three
    # channels and spills, and more for eleven.
    four_blocks = layout.warps == 8 and C <= FEW_CHANNELS and dtype is wp.float32 and cuda
    bounds = (layout.threads, 4) if four_blocks else max(layout.threads, 32)
    name = f"blend_adjoint_{C}_{thermal_channels}_{dtype.__name__}_{layout.tag}" + (f"_{A}" if A < C else "")

    @wp.kernel(
        name=name + ("_abs" if absgrad else "") + ("_slots" if by_slot else ""),
        enable_backward=False,
        module="unique",
        module_options=layout.module_options(widest_vectors=False),
        grid_stride=False,
        launch_bounds=bounds,
    )
    def blend_tiles_adjoint_kernel(
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
        features: rowsA,
        rest: rowsB,
        gaussian_ids: wp.array(dtype=wp.int32),
        masks: wp.array(dtype=wp.uint8),
        slots: wp.array(dtype=wp.int32),
        tile_offsets: wp.array(dtype=wp.int32),
        segment: int,
        states: wp.array3d(dtype=dtype),
        transmittance: wp.array2d(dtype=dtype),
        last_pairs: wp.array2d(dtype=wp.int32),
        thermal_transmittance: wp.array2d(dtype=dtype),
        thermal_last_pairs: wp.array2d(dtype=wp.int32),
        v_render: wp.array2d(dtype=vecA),
        v_render_rest: wp.array2d(dtype=vecB),
        sign: dtype,
        v_transmittance: wp.array2d(dtype=dtype),
        v_thermal_render: wp.array2d(dtype=vecD),
        v_thermal_transmittance: wp.array2d(dtype=dtype),
        # outputs
        records: records_type,
        v_features: rowsA,
        v_rest: rowsB,
    ):
        block, thread = wp.tid()
        block = block + first_block
        tile, begin, end, _ = list_of_block(block, tile_offsets, segment)
        if begin >= end:
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
        S = vecP()
        St = vecP()
        last = vecPi()
        last_t = vecPi()
        v_pixel = matCP()
        v_pixel_t = matDP()
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
                if x < width and y < height:
                    line = image * height + y
                    T[p] = transmittance[line, x]
                    # gradients that are not given are zero
                    if v_transmittance.shape[0] > 0:
                        S[p] = sign * v_transmittance[line, x] * T[p]
                    last[p] = last_pairs[line, x]
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
                        T[p] = states[end // segment, 0, place]
                        for c in range(C):
                            S[p] += states[end // segment, first_behind + c, place] * v_pixel[c, p]
                    if wp.static(dual):
                        Tt[p] = thermal_transmittance[line, x]
                        if v_thermal_transmittance.shape[0] > 0:
                            St[p] = sign * v_thermal_transmittance[line, x] * Tt[p]
                        last_t[p] = thermal_last_pairs[line, x]
                        newest = wp.max(newest, last_t[p])
                        if v_thermal_render.shape[0] > 0:
                            vt = v_thermal_render[line, x]
                            for c in range(D):
                                v_pixel_t[c, p] = vt[c]
                        if last_t[p] >= end:
                            Tt[p] = states[end // segment, 1, place]
                            for c in range(D):
                                St[p] += states[end // segment, first_behind_t + c, place] * v_pixel_t[c, p]

        i = wp.min(int(warp_max(newest)), end - 1)
        # The next up to 32 to be walked; on CUDA each lane has one
        count = wp.min(batch, i - begin + 1)
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
            mask = mask_of(i - lane, begin, masks)
            put, i, mask = refill(queue, lane, parts, taken, put, i, mask, begin, masks)
            count, place, g = take(queue, lane, taken, put, gaussian_ids)
        while count > 0:
            walked = count
            if wp.static(cuda):
                store(
                    address, lane, count, place, g, middle,
                    means2d, packed_roots, opacities, thermal_opacities, features, rest,
                )  # fmt: skip
                taken += count
                put, i, mask = refill(queue, lane, parts, taken, put, i, mask, begin, masks)
                count, place, g = take(queue, lane, taken, put, gaussian_ids)

            for k in range(walked):
                pair = i - k
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
                    gaussian = integer(entry[8])
                    if wp.static(staged):
                        for c in range(C):
                            f[c] = entry[header + c]
                    else:
                        f = features_of(gaussian, features, rest)
                else:
                    gaussian = gaussian_ids[pair]
                    root = packed_roots[gaussian]
                    m = from_middle(means2d[gaussian], root, middle)
                    U = in_units(root)
                    o = opacities[gaussian]
                    ot = thermal_opacities[gaussian]
                    f = features_of(gaussian, features, rest)
                    row_first, row_end = row_range(m, extents[gaussian], y0, rows)
                part = matLS()
                hits = int(0)
                for row in range(row_first, row_end):
                    offset = (row & row_mask) * columns
                    # f · dL/dcolour of every pixel of the row
                    dot = vecQ()
                    dot_t = vecQ()
                    for c in range(C):
                        for q in range(columns):
                            dot[q] += f[c] * v_pixel[c, offset + q]
                    if wp.static(dual):
                        for c in range(D):
                            for q in range(columns):
                                dot_t[q] += f[first_thermal + c] * v_pixel_t[c, offset + q]
                    weight = vecQ()
                    weight_t = vecQ()
                    for q in range(columns):
                        zx, zy = whiten(U, m[0] - PX[q], m[1] - (PY[q] + dtype(row)))
                        seen = visibility(zx, zy)
                        a = alpha(o, seen)
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
                            a = alpha(ot, seen)
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
                        accumulate(records, v_features, v_rest, destination, lane, G)
                    else:
                        store_column_sums(records, destination, part)
            if wp.static(not cuda):
                i -= walked
                count = wp.min(batch, i - begin + 1)

    return blend_tiles_adjoint_kernel
