"""Which Gaussians touch which tile, in depth order: count, compact, sort, scan, emit, sort, tile ranges. No gradient.

Of many Gaussians those without tiles are left out first, keeping the order of the others. Then Gaussians are sorted by
depth (stable, so that equal depths keep their index order); pairs are emitted in that
order and sorted, again stably, by tile alone, whose keys have few bits. A *pair* is one (Gaussian, tile) overlap; the
pairs of one Gaussian are contiguous before the second sort, which is what the deterministic adjoint sums over.

Which tiles an ellipse touches is exact (tile_overlap). On CUDA the same is asked of quarters of a row of tiles, and a
pair carries, above the bits it is sorted by, which eighths of its tile the ellipse touches.
"""

import functools
from dataclasses import dataclass

import warp as wp

from warp_kernels.lanes import count_bits, first_bit, warp_ballot, warp_scan, warp_sum
from warp_kernels.tile_overlap import overlap_functions

MASK_COLUMNS, MASK_ROWS = 2, 4
"""Parts of a tile that a pair's mask tells apart, row by row from the lowest bit."""

MASK_SHIFT = 24
"""Bits of a key in front of the mask, for the tile."""

LARGE_ROWS, LARGE_TILES = 32, 256
"""Rows of tiles, or tiles, above which a whole warp counts or emits a Gaussian's pairs. Lanes take those of fewer one
each, all at once."""

Totals = wp.types.vector(2, wp.int64)
"""Pairs, and Gaussians with any."""


@functools.cache
def binning_kernels(dtype: type, lanes: int):
    """The kernels of this stage.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the projected Gaussians.
        lanes: lanes in a warp: 32 on CUDA, 1 on the CPU.

    Returns:
        ``(count, compact, gather, emit)``. All but gather are launched over ``whole_warps``.
    """
    vec2, vec3, vec4 = (wp.types.vector(count, dtype) for count in (2, 3, 4))
    pixel_rows, tile_range, ellipse, pixel_span = overlap_functions(dtype)
    infinity = dtype(float("inf"))
    parts = wp.types.vector(MASK_ROWS, wp.int32)
    bounds = (256, 3) if dtype is wp.float32 else None  # three blocks a multiprocessor, which mostly wait for memory

    @wp.func
    def tiles_of_row(mean2d: vec2, extent: vec2, shape: vec4, row: int, width: int, height: int, tile_size: int):
        """Tiles [first, end) of a row of tiles that the ellipse touches."""
        bottom = wp.min((row + 1) * tile_size, height)
        first, end = pixel_span(mean2d, extent, shape, row * tile_size, bottom, width)
        return tile_range(first, end, tile_size)

    @wp.func
    def count_rows(
        mean2d: vec2,
        extent: vec2,
        shape: vec4,
        row: int,
        row_end: int,
        step: int,
        width: int,
        height: int,
        tile_size: int,
    ):
        """Tiles that the ellipse touches in every ``step``-th row of tiles from ``row`` on."""
        count = int(0)
        for r in range(row, row_end, step):
            start, end = tiles_of_row(mean2d, extent, shape, r, width, height, tile_size)
            count += end - start
        return count

    @wp.func
    def count_large(
        large: bool,
        index: int,
        lane: int,
        width: int,
        height: int,
        tile_size: int,
        means2d: wp.array(dtype=vec2),
        roots: wp.array(dtype=vec3),
        extents: wp.array(dtype=vec2),
        opacities: wp.array(dtype=dtype),
        thermal_opacities: wp.array(dtype=dtype),
    ):
        """Tiles of this lane's Gaussian where it is ``large``: of one such after the other all lanes count rows."""
        count = int(0)
        waiting = warp_ballot(wp.where(large, 1, 0))
        while waiting != wp.uint32(0):
            leader = first_bit(waiting)
            waiting = waiting & (waiting - wp.uint32(1))
            g = index - lane + leader
            extent = extents[g]
            shape = ellipse(roots[g], extent, wp.max(opacities[g], thermal_opacities[g]))
            y, y_end = pixel_rows(means2d[g], extent, height)
            row, row_end = tile_range(y, y_end, tile_size)
            own = count_rows(means2d[g], extent, shape, row + lane, row_end, lanes, width, height, tile_size)
            total = int(warp_sum(wp.uint32(own)))
            if lane == leader:
                count = total
        return count

    @wp.kernel(name=f"count_tiles_{dtype.__name__}_{lanes}", enable_backward=False, module="unique")
    def count_tiles_kernel(
        first: int,
        width: int,
        height: int,
        tile_size: int,
        means2d: wp.array(dtype=vec2),
        roots: wp.array(dtype=vec3),
        extents: wp.array(dtype=vec2),
        depths: wp.array(dtype=dtype),
        opacities: wp.array(dtype=dtype),
        thermal_opacities: wp.array(dtype=dtype),
        features: wp.array2d(dtype=dtype),
        rest: wp.array2d(dtype=dtype),
        # outputs
        radii: wp.array(dtype=wp.vec2i),
        tiles_per_gaussian: wp.array(dtype=wp.int32),
        warp_totals: wp.array(dtype=Totals),
        depth_keys: wp.array(dtype=dtype),
        order: wp.array(dtype=wp.int32),
    ):
        """With ``warp_totals`` notes each warp's pairs and Gaussians, without writes the keys to sort by."""
        index = wp.tid() + first
        lane = index % lanes
        inside = index < radii.shape[0]
        count = int(0)
        large = bool(False)
        if inside and radii[index][0] > 0:
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
                if wp.static(lanes > 1):
                    large = row_end - row > wp.static(LARGE_ROWS)
                if not large:
                    count = count_rows(mean2d, extent, shape, row, row_end, 1, width, height, tile_size)
            else:
                # A Gaussian whose colour or features are not finite would spread over every pixel it touches.
                radii[index] = wp.vec2i(0, 0)
        if wp.static(lanes > 1):
            count += count_large(
                large, index, lane, width, height, tile_size, means2d, roots, extents, opacities, thermal_opacities
            )
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
        tiles_per_gaussian: wp.array(dtype=wp.int32),
        totals: wp.array(dtype=Totals),
        depths: wp.array(dtype=dtype),
        # outputs
        depth_keys: wp.array(dtype=dtype),
        order: wp.array(dtype=wp.int32),
    ):
        """Lists the Gaussians with tiles in the order of their indices; what remains of the room is marked -1."""
        index = wp.tid() + first
        inside = index < tiles_per_gaussian.shape[0]
        lists = bool(False)
        if inside:
            lists = tiles_per_gaussian[index] > 0
        listed = warp_ballot(wp.where(lists, 1, 0))
        behind = listed >> wp.uint32(index % lanes)  # this lane's and those of the lanes after it
        if lists:
            place = int(totals[index // lanes][1]) - count_bits(behind)
            if place < room:
                depth_keys[place] = depths[index]
                order[place] = index
        if index < room and wp.int64(index) >= totals[totals.shape[0] - 1][1]:
            depth_keys[index] = infinity
            order[index] = -1

    @wp.kernel(name="gather_counts", enable_backward=False, module="unique")
    def gather_counts_kernel(
        sorted_gaussians: wp.array(dtype=wp.int32),
        tiles_per_gaussian: wp.array(dtype=wp.int32),
        # outputs
        order: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int64),
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
        keys: wp.array(dtype=wp.int32),
        values: wp.array(dtype=wp.int32),
        owners: wp.array(dtype=wp.int32),
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
        name=f"emit_pairs_{dtype.__name__}_{lanes}", enable_backward=False, module="unique", launch_bounds=bounds
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
        means2d: wp.array(dtype=vec2),
        roots: wp.array(dtype=vec3),
        extents: wp.array(dtype=vec2),
        opacities: wp.array(dtype=dtype),
        thermal_opacities: wp.array(dtype=dtype),
        order: wp.array(dtype=wp.int32),
        tiles_per_gaussian: wp.array(dtype=wp.int32),
        pair_ends: wp.array(dtype=wp.int64),
        # outputs
        keys: wp.array(dtype=wp.int32),
        values: wp.array(dtype=wp.int32),
        owners: wp.array(dtype=wp.int32),
    ):
        own_rank = wp.tid() + first
        lane = own_rank % lanes
        count = int(0)
        if own_rank < order.shape[0]:
            if order[own_rank] >= 0:
                count = tiles_per_gaussian[order[own_rank]]
                if pair_ends[own_rank] - wp.int64(count) >= wp.int64(capacity):
                    count = int(0)  # no room
        # First each lane emits a Gaussian of its own; then all lanes one large one after the other, some rows each.
        large = lanes > 1 and count > wp.static(LARGE_TILES)
        waiting = warp_ballot(wp.where(large, 1, 0))
        together = bool(False)
        rank = int(own_rank)
        emits = count > 0 and not large
        done = bool(False)
        while not done:
            if emits:
                index = order[rank]
                mean2d = means2d[index]
                extent = extents[index]
                shape = ellipse(roots[index], extent, wp.max(opacities[index], thermal_opacities[index]))
                image_first = (index // num_gaussians) * tiles_x * tiles_y
                slot = int(pair_ends[rank] - wp.int64(tiles_per_gaussian[index]))
                y, y_end = pixel_rows(mean2d, extent, height)
                row, row_end = tile_range(y, y_end, tile_size)
                if wp.static(lanes > 1):
                    if together:
                        share = (row_end - row + lanes - 1) // lanes
                        row = wp.min(row + lane * share, row_end)
                        row_end = wp.min(row + share, row_end)
                        tiles = count_rows(mean2d, extent, shape, row, row_end, 1, width, height, tile_size)
                        slot += warp_scan(tiles) - tiles
                for r in range(row, row_end):
                    start, end = tiles_of_row(mean2d, extent, shape, r, width, height, tile_size)
                    emit_row(
                        index, r, start, end, slot, mean2d, extent, shape, image_first, width, height, tile_size,
                        tiles_x, by_slot, masked, capacity, keys, values, owners,
                    )  # fmt: skip
                    slot += end - start
            done = waiting == wp.uint32(0)
            if not done:
                rank = own_rank - lane + first_bit(waiting)
                waiting = waiting & (waiting - wp.uint32(1))
                together = True
                emits = True

    return count_tiles_kernel, compact_gaussians_kernel, gather_counts_kernel, emit_pairs_kernel


@wp.kernel(enable_backward=False, module="unique")
def tile_ranges_kernel(
    capacity: int,
    num_tiles: int,
    by_slot: bool,
    masked: bool,
    pair_ends: wp.array(dtype=wp.int64),
    keys: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.int32),
    owners: wp.array(dtype=wp.int32),
    # outputs
    tile_offsets: wp.array(dtype=wp.int32),
    gaussian_ids: wp.array(dtype=wp.int32),
    masks: wp.array(dtype=wp.uint8),
):
    """Offsets of each tile's pairs in the sorted list, and each sorted pair's Gaussian and mask; threads: capacity + 1.

    Without ``masked`` keys are tiles, and masks, where wanted, all of a tile.
    """
    tile_bits = wp.where(masked, wp.static(2**MASK_SHIFT - 1), -1)
    k = wp.tid()
    num_pairs = int(0)
    if pair_ends.shape[0] > 0:
        num_pairs = int(wp.min(pair_ends[pair_ends.shape[0] - 1], wp.int64(capacity)))
    if k > num_pairs:
        return
    tile = num_tiles
    if k < num_pairs:
        tile = keys[k] & tile_bits
        if by_slot:
            gaussian_ids[k] = owners[values[k]]
        else:
            gaussian_ids[k] = values[k]
        if masks.shape[0] > 0:
            masks[k] = wp.uint8(wp.where(masked, keys[k] >> wp.static(MASK_SHIFT), -1))
    previous = int(-1)
    if k > 0:
        previous = keys[k - 1] & tile_bits
    while previous < tile:
        previous += 1
        tile_offsets[previous] = k


@dataclass
class TileBins:
    """Pairs sorted by image, tile and depth.

    Attributes:
        gaussian_ids: [num_pairs] flat (image, Gaussian) index of each sorted pair.
        masks: uint8 [num_pairs] parts of its tile that each sorted pair can reach, a bit each; empty on the CPU.
        tile_offsets: [images · tiles + 1] first sorted pair of each tile; the last entry is the number of pairs.
        order: [ranks] flat indices in depth order; those without tiles, or -1 in their place, are last or left out.
        pair_ends: int64 [ranks] end of each depth rank's range of unsorted pairs. The blending reads this and ``order``
            only with ``slots``.
        totals: the last entry holds the pairs and the Gaussians there are, room for them or not; None where
            ``pair_ends`` has all Gaussians.
        tiles_per_gaussian: [images · N] number of tiles.
        slots: [pairs] unsorted position of each sorted pair; None unless the adjoint writes one record a pair.
        num_pairs: number of pairs, or the capacity where one was given; ``tile_offsets`` ends with the pairs there are.
        tile_size: edge of a tile [px].
        tiles_x: tiles across the image.
        tiles_y: tiles down the image.
    """

    gaussian_ids: wp.array
    masks: wp.array
    tile_offsets: wp.array
    order: wp.array | None
    pair_ends: wp.array | None
    totals: wp.array | None
    tiles_per_gaussian: wp.array
    slots: wp.array | None
    num_pairs: int
    tile_size: int
    tiles_x: int
    tiles_y: int
