"""The light that segments of long lists let through: the transmittance alone, before the blending; see list_segments.

A pixel's walk is that of ``blending``. It begins with T = 1 at the segment's front. What is left behind the segment is
its factor of the light, 0 where the pixel would stop within it.
"""

import warp as wp

from warp_kernels.blending.blend_variant import BlendVariant
from warp_kernels.blending.blending import BATCH
from warp_kernels.blending.list_segments import list_of_block
from warp_kernels.constants import TRANSMITTANCE_MIN
from warp_kernels.machinery.lanes import lane_functions, warp_any
from warp_kernels.machinery.loading import made_once


@made_once
def segment_light_kernel(variant: BlendVariant) -> wp.Kernel:
    """The kernel, one block of threads a list or a segment of a long one; whole lists and last segments need no light.

    Args:
        variant: channels, opacities, precision and deal of pixels.

    Returns:
        The Warp kernel.
    """
    dtype, layout, dual, cuda = variant.dtype, variant.layout, variant.dual, variant.cuda
    lanes, rows, columns, threads, pixels = layout.lanes, layout.rows, layout.columns, layout.threads, variant.pixels
    row_mask = rows - 1  # as in blending
    tile_size, block_width, block_height = layout.tile_size, layout.block_width, layout.block_height
    blocks_x, batch = layout.blocks_x, BATCH
    zero, half, one, minus_one = dtype(0.0), dtype(0.5), dtype(1.0), dtype(-1.0)
    transmittance_min = dtype(TRANSMITTANCE_MIN)
    kinds, response, attenuate = variant.types, variant.response, lane_functions(dtype)[1]
    survivors, waiting = variant.records(staged=False), variant.queue(backwards=False)

    @wp.kernel(
        name=variant.name("segment_light"),
        enable_backward=False,
        module="unique",
        module_options=layout.module_options(widest_vectors=True),
        grid_stride=False,
        launch_bounds=max(layout.threads, 32),
    )
    def segment_light_kernel(
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
        features: wp.array(dtype=kinds.vecA),  # [images · N]; not read
        rest: wp.array(dtype=kinds.vecB),  # [images · N]; not read
        gaussian_ids: wp.array(dtype=wp.int32),  # [pairs]
        masks: wp.array(dtype=wp.uint8),  # [pairs]; read on CUDA alone
        tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
        segment: int,
        cuts: wp.array(dtype=wp.int32),  # [tiles + rows + 1]
        # outputs
        states: wp.array3d(dtype=dtype),  # [rows, state_length, pixels of a tile]
    ):
        block, thread = wp.tid()
        block = block + first_block
        tile, first_pair, end, cut, to_row = list_of_block(block, tile_offsets, segment, cuts)
        if first_pair > end:
            return
        i = int(first_pair)
        if not cut or end == tile_offsets[tile + 1]:
            return
        warp = thread // lanes
        lane = thread % lanes
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
        for r in range(rows):
            for q in range(columns):
                p = r * columns + q
                inside = int(middle[0] + PX[q]) < width and int(middle[1] + PY[q]) + r < height
                T[p] = wp.where(inside, one, minus_one)
                Tt[p] = wp.where(inside, one, minus_one)

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
                gaussian = int(0)
                m = kinds.vec2()
                U = kinds.vec3()
                o = zero
                ot = zero
                row_first = int(0)
                row_end = int(1)
                if wp.static(cuda):
                    entry = survivors.get(address, k)
                    m = kinds.vec2(entry[0], entry[1])
                    U = kinds.vec3(entry[2], entry[3], entry[4])
                    o = entry[5]
                    ot = entry[6]
                else:
                    gaussian = gaussian_ids[i + k]
                    root = packed_roots[gaussian]
                    m = response.from_middle(means2d[gaussian], root, middle)
                    U = response.in_units(root)
                    o = opacities[gaussian]
                    ot = thermal_opacities[gaussian]
                    row_first, row_end = response.row_range(m, extents[gaussian], y0, rows)
                for row in range(row_first, row_end):
                    offset = (row & row_mask) * columns
                    for q in range(columns):
                        zx, zy = response.whiten(U, m[0] - PX[q], m[1] - (PY[q] + dtype(row)))
                        seen = response.visibility(zx, zy)
                        a = response.alpha(o, seen)
                        t = T[offset + q]
                        next_t = attenuate(t, a)
                        T[offset + q] = wp.where(next_t <= transmittance_min, -wp.abs(t), next_t)
                        if wp.static(dual):
                            a = response.alpha(ot, seen)
                            t = Tt[offset + q]
                            next_t = attenuate(t, a)
                            Tt[offset + q] = wp.where(next_t <= transmittance_min, -wp.abs(t), next_t)
            if wp.static(not cuda):
                i += walked
                count = wp.min(batch, end - i)

        for p in range(pixels):
            place = p * threads + thread
            states[end // segment + to_row, 0, place] = wp.max(T[p], zero)
            if wp.static(dual):
                states[end // segment + to_row, 1, place] = wp.max(Tt[p], zero)

    return segment_light_kernel
