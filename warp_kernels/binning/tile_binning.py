"""Which Gaussians touch which tile, in depth order: count, compact, sort, scan, emit, sort (then tile_ranges.py).

Of many Gaussians those without tiles are left out first, keeping the order of the others. Then Gaussians are sorted by
depth (stable, so that equal depths keep their index order); pairs are emitted in that
order and sorted, again stably, by tile alone, whose keys have few bits. A *pair* is one (Gaussian, tile) overlap; the
pairs of one Gaussian are contiguous before the second sort, which is what the deterministic adjoint sums over. Nothing
here has a gradient.

Which tiles an ellipse touches is exact (tile_overlap). On CUDA the same is asked of quarters of a row of tiles, and a
pair carries, above the bits it is sorted by, which eighths of its tile the ellipse touches.
"""

import warp as wp

from warp_kernels.binning.tile_overlap import overlap_functions
from warp_kernels.machinery.flat_index import image_of
from warp_kernels.machinery.lanes import (
    count_bits,
    shuffle_function,
    warp_ballot,
    warp_owner,
    warp_scan,
    warp_shuffle,
    warp_sum,
)
from warp_kernels.machinery.launching import SMALL_BLOCK
from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.warp_lists import EACH

MASK_COLUMNS, MASK_ROWS = 2, 4
"""Parts of a tile that a pair's mask tells apart, row by row from the lowest bit."""

MASK_SHIFT = 24
"""Bits of a key in front of the mask, for the tile."""

Totals = wp.types.vector(2, wp.int64)
"""Pairs, and Gaussians with any."""


@made_once
def binning_kernels(dtype: type, lanes: int):
    """The kernels of this stage.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the projected Gaussians.
        lanes: lanes in a warp: 32 on CUDA, 1 on the CPU.

    Returns:
        ``(count, compact, gather, emit)``. Counting and emission are launched over ``whole_warps``, the compaction
        on CUDA over ``threads_of_many``; counting and emission in blocks of ``SMALL_BLOCK``.
    """
    vec2, vec3, vec4 = (wp.types.vector(count, dtype) for count in (2, 3, 4))
    pixel_rows, tile_range, ellipse, pixel_span = overlap_functions(dtype)
    infinity = dtype(float("inf"))
    shuffle = shuffle_function(dtype)
    parts = wp.types.vector(MASK_ROWS, wp.int32)
    each = EACH if lanes > 1 else 1  # Gaussians that a thread of the compaction looks at
    vec_each = wp.types.vector(each, wp.int32)
    # blocks a multiprocessor, which mostly wait for memory
    count_bounds, emit_bounds = ((SMALL_BLOCK, 12), (SMALL_BLOCK, 6)) if dtype is wp.float32 else (None, None)

    @wp.func
    def tiles_of_row(mean2d: vec2, extent: vec2, shape: vec4, row: int, width: int, height: int, tile_size: int):
        """Tiles [first, end) of a row of tiles that the ellipse touches."""
        bottom = wp.min((row + 1) * tile_size, height)
        first, end = pixel_span(mean2d, extent, shape, row * tile_size, bottom, width)
        return tile_range(first, end, tile_size)

    @wp.func
    def of_lane(lane: int, mean2d: vec2, extent: vec2, shape: vec4):
        """That lane's ellipse."""
        mean = vec2(shuffle(mean2d[0], lane), shuffle(mean2d[1], lane))
        half_size = vec2(shuffle(extent[0], lane), shuffle(extent[1], lane))
        rest = vec4(shuffle(shape[0], lane), shuffle(shape[1], lane), shuffle(shape[2], lane), shuffle(shape[3], lane))
        return mean, half_size, rest

    @wp.kernel(
        name=f"count_tiles_{dtype.__name__}_{lanes}",
        enable_backward=False,
        module="unique",
        launch_bounds=count_bounds,
    )
    def count_tiles_kernel(
        first: int,
        width: int,
        height: int,
        tile_size: int,
        means2d: wp.array(dtype=vec2),  # [images · N]
        roots: wp.array(dtype=vec3),  # [images · N]
        extents: wp.array(dtype=vec2),  # [images · N]
        depths: wp.array(dtype=dtype),  # [images · N]
        opacities: wp.array(dtype=dtype),  # [images · N]
        thermal_opacities: wp.array(dtype=dtype),  # [images · N]
        features: wp.array2d(dtype=dtype),  # [images · N, A]
        rest: wp.array2d(dtype=dtype),  # [images · N, B]; [0, 0]: there are no others
        # outputs
        visible: wp.array(dtype=wp.bool),  # [images · N]
        tiles_per_gaussian: wp.array(dtype=wp.int32),  # [images · N]
        warp_totals: wp.array(dtype=Totals),  # [warps of the launch]; [0]: keys are written instead
        depth_keys: wp.array(dtype=dtype),  # [2 · images · N], the first half; [0] with warp_totals
        order: wp.array(dtype=wp.int32),  # [2 · images · N], the first half; [0] with warp_totals
    ):
        """With ``warp_totals`` notes each warp's pairs and Gaussians, without writes the keys to sort by."""
        index = wp.tid() + first
        lane = index % lanes
        inside = index < visible.shape[0]
        mean2d = vec2()
        extent = vec2()
        shape = vec4()
        row = int(0)
        row_end = int(0)
        if inside and visible[index]:
            # read before the features are looked at, so that nothing is waited for twice
            mean2d = means2d[index]
            extent = extents[index]
            shape = ellipse(roots[index], extent, wp.max(opacities[index], thermal_opacities[index]))
            finite = bool(True)
            for c in range(features.shape[1]):
                if not wp.isfinite(features[index, c]):
                    finite = False
            for c in range(rest.shape[1]):
                if not wp.isfinite(rest[index, c]):
                    finite = False
            if finite:
                y, y_end = pixel_rows(mean2d, extent, height)
                row, row_end = tile_range(y, y_end, tile_size)
            else:
                # A Gaussian whose colour or features are not finite would spread over every pixel it touches.
                visible[index] = False
        # The rows of the warp's Gaussians are dealt to its lanes, one after the other.
        end = warp_scan(row_end - row)
        rows = warp_shuffle(end, lanes - 1)
        dealt = int(0)
        tiles_before = int(0)
        tiles_to_end = int(0)  # of this Gaussian and those before it in the warp
        while dealt < rows:
            item = dealt + lane
            owner = warp_owner(end, item)
            r = warp_shuffle(row_end - end, owner) + item
            mean, half_size, others = of_lane(owner, mean2d, extent, shape)
            tiles = int(0)
            if item < rows:
                start, stop = tiles_of_row(mean, half_size, others, r, width, height, tile_size)
                tiles = stop - start
            total = tiles_before + warp_scan(tiles)
            last = end - 1 - dealt
            total_there = warp_shuffle(total, wp.clamp(last, 0, lanes - 1))
            if last >= 0 and last < lanes:
                tiles_to_end = total_there
            tiles_before = warp_shuffle(total, lanes - 1)
            dealt += lanes
        count = tiles_to_end
        before = warp_shuffle(tiles_to_end, wp.max(lane - 1, 0))
        if lane > 0:
            count -= before
        if inside:
            tiles_per_gaussian[index] = count
        if warp_totals.shape[0] > 0:
            pairs = warp_sum(wp.uint32(count))
            gaussians = count_bits(warp_ballot(wp.where(count > 0, 1, 0)))
            if lane == 0:
                warp_totals[index // lanes] = Totals(wp.int64(pairs), wp.int64(gaussians))
        elif inside:
            depth_keys[index] = wp.where(count > 0, depths[index], infinity)
            order[index] = index

    @wp.kernel(name=f"compact_gaussians_{dtype.__name__}_{lanes}", enable_backward=False, module="unique")
    def compact_gaussians_kernel(
        first: int,
        room: int,
        tiles_per_gaussian: wp.array(dtype=wp.int32),  # [images · N]
        totals: wp.array(dtype=Totals),  # [warps of the count]
        depths: wp.array(dtype=dtype),  # [images · N]
        # outputs
        depth_keys: wp.array(dtype=dtype),  # [2 · ranks], the first half
        order: wp.array(dtype=wp.int32),  # [2 · ranks], the first half
    ):
        """Lists the Gaussians with tiles in the order of their indices; what remains of the room is marked -1."""
        thread = wp.tid() + first
        lane = thread % lanes
        nearest = (thread // lanes) * wp.static(each * lanes) + lane
        count = vec_each()
        for j in range(each):  # all are asked for before the first is looked at
            if nearest + j * lanes < tiles_per_gaussian.shape[0]:
                count[j] = tiles_per_gaussian[nearest + j * lanes]
        num_listed = totals[totals.shape[0] - 1][1]
        for j in range(each):
            index = nearest + j * lanes
            behind = warp_ballot(wp.where(count[j] > 0, 1, 0)) >> wp.uint32(lane)  # this lane's and those after it
            if count[j] > 0:
                place = int(totals[index // lanes][1]) - count_bits(behind)
                if place < room:
                    depth_keys[place] = depths[index]
                    order[place] = index
            if index < room and wp.int64(index) >= num_listed:
                depth_keys[index] = infinity
                order[index] = -1

    @wp.kernel(name="gather_counts", enable_backward=False, module="unique")
    def gather_counts_kernel(
        sorted_gaussians: wp.array(dtype=wp.int32),  # [2 · ranks], the first half
        tiles_per_gaussian: wp.array(dtype=wp.int32),  # [images · N]
        # outputs
        order: wp.array(dtype=wp.int32),  # [ranks]
        counts: wp.array(dtype=wp.int64),  # [ranks]
    ):
        rank = wp.tid()
        index = sorted_gaussians[rank]
        count = wp.int64(0)
        if index >= 0:
            count = wp.int64(tiles_per_gaussian[index])
        order[rank] = index
        counts[rank] = count

    @wp.func
    def emit_row(
        index: int,
        row: int,
        start: int,
        end: int,
        slot: int,
        mean2d: vec2,
        extent: vec2,
        shape: vec4,
        image_first: int,
        width: int,
        height: int,
        tile_size: int,
        tiles_x: int,
        by_slot: bool,
        masked: bool,
        capacity: int,
        keys: wp.array(dtype=wp.int32),  # [2 · pairs], the first half
        values: wp.array(dtype=wp.int32),  # [2 · pairs], the first half
        owners: wp.array(dtype=wp.int32),  # [pairs]; [0] without by_slot
    ):
        """Writes a Gaussian's pairs with the tiles [start, end) of a row from ``slot`` on, as far as there is room."""
        # columns of pixels that the ellipse touches in each of the row's parts, and those that it does in all of them
        left = parts()
        right = parts()
        inner = int(0)
        inner_end = width
        whole = int(0)
        if masked and end > start:
            y, y_end = pixel_rows(mean2d, extent, height)
            for part in range(wp.static(MASK_ROWS)):
                top = row * tile_size + part * (tile_size // wp.static(MASK_ROWS))
                bottom = wp.min(top + tile_size // wp.static(MASK_ROWS), height)
                if wp.max(top, y) < wp.min(bottom, y_end):
                    x_first, x_end = pixel_span(mean2d, extent, shape, top, bottom, width)
                    left[part] = x_first
                    right[part] = x_end
                    inner = wp.max(inner, x_first)
                    inner_end = wp.min(inner_end, x_end)
                    whole |= wp.static(2**MASK_COLUMNS - 1) << (wp.static(MASK_SHIFT) + part * wp.static(MASK_COLUMNS))
        for tile in range(start, wp.min(end, start + (capacity - slot))):
            mask = whole
            if masked and (tile * tile_size < inner or wp.min((tile + 1) * tile_size, width) > inner_end):
                mask = int(0)
                for part in range(wp.static(MASK_ROWS)):
                    for column in range(wp.static(MASK_COLUMNS)):
                        x = tile * tile_size + column * (tile_size // wp.static(MASK_COLUMNS))
                        if left[part] < x + tile_size // wp.static(MASK_COLUMNS) and right[part] > x:
                            mask |= 1 << (wp.static(MASK_SHIFT) + part * wp.static(MASK_COLUMNS) + column)
            at = slot + tile - start
            keys[at] = (image_first + row * tiles_x + tile) | mask
            if by_slot:
                values[at] = at
                owners[at] = index
            else:
                values[at] = index

    @wp.kernel(
        name=f"emit_pairs_{dtype.__name__}_{lanes}", enable_backward=False, module="unique", launch_bounds=emit_bounds
    )
    def emit_pairs_kernel(
        first: int,
        num_gaussians: int,
        width: int,
        height: int,
        tile_size: int,
        tiles_x: int,
        tiles_y: int,
        by_slot: bool,
        masked: bool,
        capacity: int,
        means2d: wp.array(dtype=vec2),  # [images · N]
        roots: wp.array(dtype=vec3),  # [images · N]
        extents: wp.array(dtype=vec2),  # [images · N]
        opacities: wp.array(dtype=dtype),  # [images · N]
        thermal_opacities: wp.array(dtype=dtype),  # [images · N]
        order: wp.array(dtype=wp.int32),  # [ranks]
        pair_ends: wp.array(dtype=wp.int64),  # [ranks]
        # outputs
        keys: wp.array(dtype=wp.int32),  # [2 · pairs], the first half
        values: wp.array(dtype=wp.int32),  # [2 · pairs], the first half
        owners: wp.array(dtype=wp.int32),  # [pairs]; [0] without by_slot
    ):
        rank = wp.tid() + first
        lane = rank % lanes
        index = int(-1)
        slot = int(0)
        mean2d = vec2()
        extent = vec2()
        shape = vec4()
        row = int(0)
        row_end = int(0)
        if rank < order.shape[0]:
            index = order[rank]
        if index >= 0:
            begin = wp.int64(0)
            if rank > 0:
                begin = pair_ends[rank - 1]
            slot = int(wp.min(begin, wp.int64(capacity)))
            if pair_ends[rank] > begin and slot < capacity:
                mean2d = means2d[index]
                extent = extents[index]
                shape = ellipse(roots[index], extent, wp.max(opacities[index], thermal_opacities[index]))
                y, y_end = pixel_rows(mean2d, extent, height)
                row, row_end = tile_range(y, y_end, tile_size)
        end = warp_scan(row_end - row)
        rows = warp_shuffle(end, lanes - 1)
        slot = warp_shuffle(slot, 0)  # from where on the pairs of the warp's Gaussians lie side by side
        dealt = int(0)
        while dealt < rows:
            item = dealt + lane
            owner = warp_owner(end, item)
            g = warp_shuffle(index, owner)
            r = warp_shuffle(row_end - end, owner) + item
            mean, half_size, others = of_lane(owner, mean2d, extent, shape)
            start = int(0)
            stop = int(0)
            if item < rows:
                start, stop = tiles_of_row(mean, half_size, others, r, width, height, tile_size)
            total = warp_scan(stop - start)
            emit_row(
                g, r, start, stop, slot + total - (stop - start), mean, half_size, others,
                image_of(g, num_gaussians) * tiles_x * tiles_y, width, height, tile_size, tiles_x, by_slot, masked,
                capacity, keys, values, owners,
            )  # fmt: skip
            slot += warp_shuffle(total, lanes - 1)
            dealt += lanes

    return count_tiles_kernel, compact_gaussians_kernel, gather_counts_kernel, emit_pairs_kernel
