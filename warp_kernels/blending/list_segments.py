"""Long lists cut into segments, each walked by its own block of threads.

A frame of few tiles takes as long as its longest list. A list of more than three segments is therefore cut where the
index of a pair is a multiple of the segment. Forward, a first launch finds what each segment leaves of the light that
enters it; a second blends every segment from the transmittance in front of it, the product over the segments before;
``join_segments`` adds up their colours. What it leaves at each boundary, T there and the colours behind, is where the
adjoint of a segment begins.

The first blocks of threads have a tile each: all of its list, or the first segment. Those behind have a boundary each
of the cut lists, and walk from there to the next. Boundaries have rows in the states, those of a list one after the
other: ``deal_states_kernel`` deals them once the lists are sorted, and counts them. An array tells of both, the *cuts*,
int32 [tiles + rows + 1]: for a tile, what takes one of its boundaries to its row; for a row, its tile + 1, or 0 where
there is none; and the number of rows that were dealt. It is zero at first.
"""

import warp as wp

from warp_kernels.blending.blend_arguments import SortedPairs
from warp_kernels.blending.blend_variant import BlendVariant
from warp_kernels.machinery.loading import made_once

LONG_LIST = 3
"""Segments' worth of pairs that one block walks without a cut."""

CHUNK = 8
"""Boundaries whose states a thread asks for at once; one after the other, each would wait for memory."""


@wp.kernel(enable_backward=False, module="unique")
def deal_states_kernel(
    tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
    segment: int,
    # outputs
    cuts: wp.array(dtype=wp.int32),  # [tiles + rows + 1]
):
    """Gives every boundary of the lists that are cut a row of the states, one thread per tile."""
    tile = wp.tid()
    begin = tile_offsets[tile]
    end = tile_offsets[tile + 1]
    if end - begin <= wp.static(LONG_LIST) * segment:
        return
    before = begin // segment
    count = (end - 1) // segment - before
    row = wp.atomic_add(cuts, cuts.shape[0] - 1, count)
    cuts[tile] = row - before - 1
    first = tile_offsets.shape[0] - 1 + row
    for k in range(first, first + count):
        cuts[k] = tile + 1


@wp.struct
class Part:
    """What a block of threads walks: a list, or a segment of one. Empty where the first pair is beyond the end."""

    tile: int
    begin: int  # of the list
    first: int
    end: int
    is_cut: bool
    is_first: bool
    is_last: bool
    to_row: int


@wp.func
def part_of_block(block: int, pairs: SortedPairs):
    """What a block of threads walks; ``to_row`` takes a boundary to its row of the states."""
    num_tiles = pairs.tile_offsets.shape[0] - 1
    part = Part()
    part.tile = block
    if block >= num_tiles:
        part.tile = pairs.cuts[block] - 1
    part.end = -1
    if part.tile >= 0:
        begin = pairs.tile_offsets[part.tile]
        end = pairs.tile_offsets[part.tile + 1]
        part.begin = begin
        part.first = begin
        part.end = end
        part.is_cut = pairs.segment > 0 and end - begin > wp.static(LONG_LIST) * pairs.segment
        if part.is_cut:
            part.to_row = pairs.cuts[part.tile]
            if block >= num_tiles:
                part.first = (block - num_tiles - part.to_row) * pairs.segment
                part.end = part.first + wp.min(end - part.first, pairs.segment)
            else:
                part.end = (begin // pairs.segment + 1) * pairs.segment
        part.is_first = part.first == begin
        part.is_last = part.end == end
    return part


@made_once
def join_segments_kernel(variant: BlendVariant) -> wp.Kernel:
    """Joins the segments of cut lists, one thread a number of a pixel: the states, and the whole render."""
    dtype, layout, kinds = variant.dtype, variant.layout, variant.types
    vec_chunk = wp.types.vector(CHUNK, dtype)
    first_behind, length = variant.first_behind, variant.state_length
    # beyond the last number where there are none
    first_behind_t = variant.first_behind_thermal + (0 if variant.dual else 1)
    lanes, columns, threads = layout.lanes, layout.columns, layout.threads
    tile_size, block_width, block_height = layout.tile_size, layout.block_width, layout.block_height
    blocks_x = layout.blocks_x
    one, zero = dtype(1.0), dtype(0.0)

    add_channel = """image.data[row * image.shape[1] + column][channel] += value;"""

    @wp.func_native(add_channel)
    def add_to_render(image: wp.array2d(dtype=kinds.vecC), row: int, column: int, channel: int, value: dtype): ...

    @wp.func_native(add_channel)
    def add_to_thermal(image: wp.array2d(dtype=kinds.vecD), row: int, column: int, channel: int, value: dtype): ...

    @wp.kernel(
        name=variant.name("join_segments", of_arrays=False),
        enable_backward=False,
        module="unique",
    )
    def join_segments_kernel(
        first: int,
        tiles_x: int,
        tiles_y: int,
        width: int,
        height: int,
        tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
        segment: int,
        cuts: wp.array(dtype=wp.int32),  # [tiles + rows + 1]
        # outputs
        render: wp.array2d(dtype=kinds.vecC),  # [images · height, width]
        thermal_render: wp.array2d(dtype=kinds.vecD),  # [images · height, width]; [0, 0]: one opacity
        states: wp.array3d(dtype=dtype),  # [rows, state_length, pixels of a tile]
    ):
        index = wp.tid() + first
        place = index % (tile_size * tile_size)
        number = (index // (tile_size * tile_size)) % length
        tile = index // (tile_size * tile_size * length)
        begin = tile_offsets[tile]
        end = tile_offsets[tile + 1]
        if end - begin <= wp.static(LONG_LIST) * segment:
            return
        warp = (place % threads) // lanes
        pixel = place % lanes + (place // threads) % columns * lanes
        in_image = tile % (tiles_x * tiles_y)
        x = (in_image % tiles_x) * tile_size + (warp % blocks_x) * block_width + pixel % block_width
        y = (in_image // tiles_x) * tile_size + (warp // blocks_x) * block_height + pixel // block_width
        y += place // (threads * columns)
        if x >= width or y >= height:
            return

        # From the front the light that is left, from behind the colours.
        oldest = begin // segment + 1 + cuts[tile]
        newest = (end - 1) // segment + cuts[tile]
        is_light = number < first_behind
        value = wp.where(is_light, one, zero)
        done = int(0)
        while done <= newest - oldest:
            chunk = vec_chunk()
            for k in range(wp.static(CHUNK)):
                row = wp.where(is_light, oldest + done + k, newest - done - k)
                if row >= oldest and row <= newest:
                    chunk[k] = states[row, number, place]
            for k in range(wp.static(CHUNK)):
                row = wp.where(is_light, oldest + done + k, newest - done - k)
                if row >= oldest and row <= newest:
                    value = wp.where(is_light, value * chunk[k], value + chunk[k])
                    states[row, number, place] = value
            done += wp.static(CHUNK)
        line = (tile // (tiles_x * tiles_y)) * height + y
        if number >= first_behind_t:
            add_to_thermal(thermal_render, line, x, number - first_behind_t, value)
        elif not is_light:
            add_to_render(render, line, x, number - first_behind, value)

    return join_segments_kernel
