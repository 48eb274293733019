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

from warp_kernels.blending.blend_arguments import SortedPairs, TileGrid
from warp_kernels.blending.blend_variant import BlendVariant
from warp_kernels.blending.list_segments import Part, part_of_block
from warp_kernels.blending.pixel_ends import end_functions
from warp_kernels.constants import TRANSMITTANCE_MIN
from warp_kernels.machinery.lanes import lane_functions, warp_any
from warp_kernels.machinery.loading import made_once


@made_once
def layer_function(dtype: type):
    """What a layer does to a pixel's light.

    Returns:
        A Warp function (light in front, alpha, the light at which the pixel stops): the layer's weight, and the light
        behind it. Where the pixel has stopped before the layer, the weight is 0 and the light in front gets a sign.
    """
    zero, attenuate = dtype(0.0), lane_functions(dtype)[1]

    @wp.func
    def behind_layer(t: dtype, a: dtype, stop_at: dtype):
        behind = attenuate(t, a)
        stop = behind <= stop_at
        return wp.where(stop, zero, a * t), wp.where(stop, -wp.abs(t), behind)

    return behind_layer


@made_once
def blend_kernel(variant: BlendVariant) -> wp.Kernel:
    """The forward kernel, one block of threads a list or a segment of a long one."""
    dtype, layout, kinds, dual = variant.dtype, variant.layout, variant.types, variant.dual
    C, D, first_thermal = variant.channels, max(variant.thermal_channels, 1), variant.first_thermal
    first_behind, first_behind_t = variant.first_behind, variant.first_behind_thermal
    lanes, rows, columns, threads, pixels = layout.lanes, layout.rows, layout.columns, layout.threads, variant.pixels
    row_mask = rows - 1  # rows is a power of two: keeps the index provably non-negative, which vectorising needs
    zero, one, minus_one, transmittance_min = dtype(0.0), dtype(1.0), dtype(-1.0), dtype(TRANSMITTANCE_MIN)
    blocks, response, walking = variant.blocks, variant.response, variant.walk(staged=variant.stages_features)
    behind_layer, pack_end = layer_function(dtype), end_functions(dtype)[0]
    Splats, PixelEnds, vec2 = kinds.Splats, kinds.PixelEnds, kinds.vec2

    @wp.func
    def stop_of(light: dtype, factor: dtype):
        """The light at which a pixel stops in a segment; negative where a later one goes on, whatever rounds here."""
        return wp.where(light * factor > transmittance_min, minus_one, transmittance_min)

    @wp.func
    def light_of_cut(
        part: Part,
        segment: int,
        states: wp.array3d(dtype=dtype),  # [rows, state_length, pixels of a tile]
        place: int,
    ):
        """The light of a pixel in front of a segment, for each opacity, and that at which it stops there."""
        light = vec2(one, one)
        stop_at = vec2(transmittance_min, transmittance_min)
        for boundary in range(part.begin // segment + 1, part.first // segment + 1):
            light[0] = light[0] * states[boundary + part.to_row, 0, place]
            if wp.static(dual):
                light[1] = light[1] * states[boundary + part.to_row, 1, place]
        if not part.is_last:
            stop_at[0] = stop_of(light[0], states[part.end // segment + part.to_row, 0, place])
            if wp.static(dual):
                stop_at[1] = stop_of(light[1], states[part.end // segment + part.to_row, 1, place])
        for k in range(2):
            if light[k] <= transmittance_min:
                light[k] = minus_one
        return light, stop_at

    @wp.func
    def write_end(pixels: PixelEnds, line: int, x: int, t: dtype, stop_at: dtype, last: int, part: Part, bits: int):
        """Where a pixel's walk ended. Of a cut list one segment alone says it: the one that the pixel may stop in."""
        if t != minus_one and stop_at > zero:
            light = wp.abs(t)
            alpha = one - light
            last_pair = wp.where(last < 0 and not part.is_first, part.first - 1, last)
            pixels.transmittance[line, x] = light
            pixels.ends[line, x] = pack_end(last_pair, light, alpha, bits)
            if pixels.alphas.shape[0] > 0:
                pixels.alphas[line, x] = alpha

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
        grid: TileGrid,
        splats: Splats,
        pairs: SortedPairs,
        bits: int,
        # outputs
        render: wp.array2d(dtype=kinds.vecC),  # [images · height, width]
        pixel_ends: PixelEnds,
        thermal_render: wp.array2d(dtype=kinds.vecD),  # [images · height, width]; [0, 0]: one opacity
        thermal_ends: PixelEnds,
        states: wp.array3d(dtype=dtype),  # [rows, state_length, pixels of a tile]
    ):
        block, thread = wp.tid()
        part = part_of_block(block + first_block, pairs)
        if part.first > part.end:
            return
        warp = thread // lanes
        lane = thread % lanes
        line_0 = part.tile // (grid.tiles_x * grid.tiles_y) * grid.height
        block_x, block_y = blocks.corner_of(part.tile, warp, grid)
        # Pixels and means are seen from the middle of the block.
        middle_x, middle_y = blocks.middle_of(block_x, block_y, grid)
        middle = vec2(dtype(middle_x), dtype(middle_y))
        PX, PY = blocks.centres(lane, middle_x - block_x, middle_y - block_y)

        # Of each pixel the light that is left, the light at which it stops, the last pair drawn, and the sums.
        T = kinds.vecP()
        Tt = kinds.vecP()
        stop_at = kinds.vecP()
        stop_at_t = kinds.vecP()
        last = kinds.vecPi()
        last_t = kinds.vecPi()
        acc = kinds.matCP()
        acc_t = kinds.matDP()
        for r in range(rows):
            for q in range(columns):
                p = r * columns + q
                inside = int(middle[0] + PX[q]) < grid.width and int(middle[1] + PY[q]) + r < grid.height
                T[p] = wp.where(inside, one, minus_one)
                Tt[p] = wp.where(inside, one, minus_one)
                last[p] = -1
                last_t[p] = -1
                stop_at[p] = transmittance_min
                stop_at_t[p] = transmittance_min
                if part.is_cut and inside:
                    light, stop = light_of_cut(part, pairs.segment, states, p * threads + thread)
                    T[p] = light[0]
                    stop_at[p] = stop[0]
                    if wp.static(dual):
                        Tt[p] = light[1]
                        stop_at_t[p] = stop[1]

        walk = walking.begin(warp, lane, part.first, part.end, pairs)
        while walk.count > 0:
            alive = int(0)
            for p in range(pixels):
                alive = alive | wp.where(T[p] > zero, 1, 0)
                if wp.static(dual):
                    alive = alive | wp.where(Tt[p] > zero, 1, 0)
            if warp_any(alive) == 0:
                break
            count = int(walk.count)
            candidate = int(walk.candidate)
            walk = walking.go_on(walk, lane, middle, splats, pairs)
            for k in range(count):
                pair, _gaussian, m, U, o, ot, f, row_first, row_end = walking.gaussian(
                    walk, candidate + k, k, middle, PY[0], splats, pairs
                )
                for row in range(row_first, row_end):
                    offset = (row & row_mask) * columns
                    weight = kinds.vecQ()
                    weight_t = kinds.vecQ()
                    for q in range(columns):
                        zx, zy = response.whiten(U, m[0] - PX[q], m[1] - (PY[q] + dtype(row)))
                        seen = response.visibility(zx, zy)
                        w, t = behind_layer(T[offset + q], response.alpha(o, seen), stop_at[offset + q])
                        T[offset + q] = t
                        last[offset + q] = wp.where(w > zero, pair, last[offset + q])
                        weight[q] = w
                        if wp.static(dual):
                            w, t = behind_layer(Tt[offset + q], response.alpha(ot, seen), stop_at_t[offset + q])
                            Tt[offset + q] = t
                            last_t[offset + q] = wp.where(w > zero, pair, last_t[offset + q])
                            weight_t[q] = w
                    for c in range(C):
                        for q in range(columns):
                            acc[c, offset + q] += weight[q] * f[c]
                    if wp.static(dual):
                        for c in range(D):
                            for q in range(columns):
                                acc_t[c, offset + q] += weight_t[q] * f[first_thermal + c]

        for r in range(rows):
            for q in range(columns):
                p = r * columns + q
                x = int(middle[0] + PX[q])
                y = int(middle[1] + PY[q]) + r
                if x < grid.width and y < grid.height:
                    line = line_0 + y
                    if part.is_first:
                        v = kinds.vecC()
                        for c in range(C):
                            v[c] = acc[c, p]
                        render[line, x] = v
                    else:
                        for c in range(C):
                            states[
                                part.first // pairs.segment + part.to_row, first_behind + c, p * threads + thread
                            ] = acc[c, p]
                    write_end(pixel_ends, line, x, T[p], stop_at[p], last[p], part, bits)
                    if wp.static(dual):
                        if part.is_first:
                            vt = kinds.vecD()
                            for c in range(D):
                                vt[c] = acc_t[c, p]
                            thermal_render[line, x] = vt
                        else:
                            for c in range(D):
                                states[
                                    part.first // pairs.segment + part.to_row, first_behind_t + c, p * threads + thread
                                ] = acc_t[c, p]
                        write_end(thermal_ends, line, x, Tt[p], stop_at_t[p], last_t[p], part, bits)

    return blend_tiles_kernel
