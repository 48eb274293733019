"""The light that segments of long lists let through: the transmittance alone, before the blending; see list_segments.

A pixel's walk is that of ``blending``. It begins with T = 1 at the segment's front. What is left behind the segment is
its factor of the light, 0 where the pixel would stop within it.
"""

import warp as wp

from warp_kernels.blending.blend_arguments import SortedPairs, TileGrid
from warp_kernels.blending.blend_variant import BlendVariant
from warp_kernels.blending.blending import layer_function
from warp_kernels.blending.list_segments import part_of_block
from warp_kernels.constants import TRANSMITTANCE_MIN
from warp_kernels.machinery.lanes import warp_any
from warp_kernels.machinery.loading import made_once


@made_once
def segment_light_kernel(variant: BlendVariant) -> wp.Kernel:
    """The kernel, one block of threads a list or a segment of a long one; whole lists and last segments need none."""
    dtype, layout, kinds, dual = variant.dtype, variant.layout, variant.types, variant.dual
    lanes, rows, columns, threads, pixels = layout.lanes, layout.rows, layout.columns, layout.threads, variant.pixels
    row_mask = rows - 1  # as in blending
    zero, one, minus_one, transmittance_min = dtype(0.0), dtype(1.0), dtype(-1.0), dtype(TRANSMITTANCE_MIN)
    blocks, response, walking = variant.blocks, variant.response, variant.walk(staged=False)
    behind_layer = layer_function(dtype)

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
        grid: TileGrid,
        splats: kinds.Splats,
        pairs: SortedPairs,
        # outputs
        states: wp.array3d(dtype=dtype),  # [rows, state_length, pixels of a tile]
    ):
        block, thread = wp.tid()
        part = part_of_block(block + first_block, pairs)
        if part.first > part.end or not part.is_cut or part.is_last:
            return
        warp = thread // lanes
        lane = thread % lanes
        block_x, block_y = blocks.corner_of(part.tile, warp, grid)
        middle_x, middle_y = blocks.middle_of(block_x, block_y, grid)
        middle = kinds.vec2(dtype(middle_x), dtype(middle_y))
        PX, PY = blocks.centres(lane, middle_x - block_x, middle_y - block_y)
        T = kinds.vecP()
        Tt = kinds.vecP()
        for r in range(rows):
            for q in range(columns):
                p = r * columns + q
                inside = int(middle[0] + PX[q]) < grid.width and int(middle[1] + PY[q]) + r < grid.height
                T[p] = wp.where(inside, one, minus_one)
                Tt[p] = wp.where(inside, one, minus_one)

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
                _pair, _gaussian, m, U, o, ot, _features, row_first, row_end = walking.gaussian(
                    walk, candidate + k, k, middle, PY[0], splats, pairs
                )
                for row in range(row_first, row_end):
                    offset = (row & row_mask) * columns
                    for q in range(columns):
                        zx, zy = response.whiten(U, m[0] - PX[q], m[1] - (PY[q] + dtype(row)))
                        seen = response.visibility(zx, zy)
                        _weight, t = behind_layer(T[offset + q], response.alpha(o, seen), transmittance_min)
                        T[offset + q] = t
                        if wp.static(dual):
                            _weight, t = behind_layer(Tt[offset + q], response.alpha(ot, seen), transmittance_min)
                            Tt[offset + q] = t

        row_of_end = part.end // pairs.segment + part.to_row
        for p in range(pixels):
            states[row_of_end, 0, p * threads + thread] = wp.max(T[p], zero)
            if wp.static(dual):
                states[row_of_end, 1, p * threads + thread] = wp.max(Tt[p], zero)

    return segment_light_kernel
