"""The Gaussians of a list that reach a warp's pixel block, kept in shared memory while the warp walks them.

The binning says for every pair which parts of its tile the Gaussian reaches (its mask). A warp looks at the masks of 32
pairs at a time, one a lane, and queues the places of those that reach its block, until 32 wait. Each lane then fetches
one of these and writes it to a record. The walk reads records one after the other, all lanes the same one: addresses
are known beforehand, so that the latency of one Gaussian's numbers hides behind the arithmetic of another.

CUDA only; on the CPU a lane, which has all of the tile, reads what it needs from the arrays.
"""

from typing import Any, NamedTuple

import warp as wp

from warp_kernels.binning.tile_binning import MASK_COLUMNS, MASK_ROWS
from warp_kernels.blending.alpha import alpha_functions
from warp_kernels.blending.blend_arguments import SortedPairs, splats_type
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.machinery.lanes import LANES_CUDA, on_cuda, warp_sync
from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.warp_lists import list_functions
from warp_kernels.projection.packed_roots import packed_root_functions

BATCH = 32
"""Gaussians walked between two checks for unfinished pixels."""

HEADER = 9
"""Numbers before the features: mean2d from the middle of the warp's block (2), root in ``alpha.UNIT`` (3), opacity,
thermal opacity, the pair's place in the list, its Gaussian."""

SHARED_BYTES = 40 * 1024
"""Shared memory for records; a block of threads has 48 KiB without asking for more, some of which Warp takes."""

QUEUE = 2 * LANES_CUDA
"""Places that can wait: all but one of a warp's worth, and 32 that come at once; a power of two."""


def stages_features(channels: int, dtype: type, layout: BlendLayout) -> bool:
    """Whether there is room for the features in the records; where not, they are read from memory.

    Args:
        channels: C.

    Returns:
        True if records hold features.
    """
    return layout.warps * LANES_CUDA * _stride(HEADER + channels, dtype) * _size(dtype) <= SHARED_BYTES


def _size(dtype: type) -> int:
    return 4 if dtype is wp.float32 else 8


def _stride(length: int, dtype: type) -> int:
    """Numbers from one record to the next, an odd number of 16-byte words: eight lanes then write to all banks."""
    words = -(-length * _size(dtype) // 16)
    return (words | 1) * 16 // _size(dtype)


@wp.struct
class Walk:
    """A warp's way along a list: the next up to 32 Gaussians to be walked, of which on CUDA each lane has one."""

    count: int
    candidate: int  # the first pair that was not looked at; on the CPU, of those to be walked
    bound: int  # forwards the first pair behind the list, backwards its first pair
    # CUDA alone: addresses of the warp's queue and records; parts of the tile that its block lies in; the mask of the
    # lane's next candidate; how many were put into the queue and taken from it; the lane's pair, and its Gaussian.
    queue: wp.uint64
    records: wp.uint64
    parts: int
    mask: int
    put: int
    taken: int
    pair: int
    gaussian: int


@made_once
def queue_functions(layout: BlendLayout, backwards: bool) -> tuple[Any, Any]:
    """From the masks of a list to the places of the pairs that reach a warp's block, in the list's order or against it.

    Args:
        backwards: from the back of the list to its front.

    Returns:
        Warp functions ``(opened, refilled)``: a walk with an empty queue; and one that waits for a warp's worth of
        places, or all that are left, and takes them.
    """
    part_width, part_height = layout.tile_size // MASK_COLUMNS, layout.tile_size // MASK_ROWS
    block_width, block_height, blocks_x = layout.block_width, layout.block_height, layout.blocks_x
    step = -1 if backwards else 1
    queue_of_warp, append, item = list_functions(layout.warps, QUEUE)

    @wp.func
    def block_parts(warp: int):
        x = (warp % blocks_x) * block_width
        y = (warp // blocks_x) * block_height
        parts = int(0)
        for row in range(wp.static(MASK_ROWS)):
            for column in range(wp.static(MASK_COLUMNS)):
                across = x < (column + 1) * part_width and x + block_width > column * part_width
                down = y < (row + 1) * part_height and y + block_height > row * part_height
                if across and down:
                    parts |= 1 << (row * wp.static(MASK_COLUMNS) + column)
        return parts

    @wp.func
    def within(place: int, bound: int):
        if wp.static(backwards):
            return place >= bound
        return place < bound

    @wp.func
    def mask_of(
        place: int,
        bound: int,
        masks: wp.array(dtype=wp.uint8),  # [pairs]
    ):
        mask = int(0)
        if within(place, bound):
            mask = int(masks[place])
        return mask

    @wp.func
    def opened(warp: int, lane: int, first: int, bound: int, pairs: SortedPairs):
        walk = Walk()
        walk.candidate = first
        walk.bound = bound
        walk.queue = queue_of_warp(warp)
        walk.parts = block_parts(warp)
        walk.mask = mask_of(first + step * lane, bound, pairs.masks)
        return walk

    @wp.func
    def refilled(walk: Walk, lane: int, pairs: SortedPairs):
        put = int(walk.put)
        candidate = int(walk.candidate)
        mask = int(walk.mask)
        warp_sync()  # all lanes have read what they took
        while put - walk.taken < LANES_CUDA and within(candidate, walk.bound):
            put = append(walk.queue, put, lane, (mask & walk.parts) != 0, candidate + step * lane)
            candidate += step * LANES_CUDA
            mask = mask_of(candidate + step * lane, walk.bound, pairs.masks)
        warp_sync()
        walk.put = put
        walk.candidate = candidate
        walk.mask = mask
        walk.count = wp.min(put - walk.taken, LANES_CUDA)
        walk.pair = 0
        walk.gaussian = 0
        if lane < walk.count:
            walk.pair = item(walk.queue, walk.taken + lane)
            walk.gaussian = pairs.gaussian_ids[walk.pair]
        return walk

    return opened, refilled


class WalkFunctions(NamedTuple):
    """Warp functions of a warp's walk along a list, on CUDA by way of records in shared memory.

    Attributes:
        begin: the walk from a pair on, up to its ``bound``.
        go_on: the walk behind the Gaussians to be walked now, which on CUDA are stored in records.
        gaussian: one of the Gaussians to be walked: its pair, its index, its mean as seen from the block's middle, the
            conic's root in ``alpha.UNIT``, both opacities, the features, and the rows of the lane that it reaches.
    """

    begin: Any
    go_on: Any
    gaussian: Any


@made_once
def walk_functions(
    channels: int, first_channels: int, staged: bool, dual: bool, dtype: type, layout: BlendLayout, backwards: bool
) -> WalkFunctions:
    """A walk along a list.

    Args:
        channels: C, features of a Gaussian.
        first_channels: of these, those that lie in an array of their own; C: all lie in one.
        staged: records hold them.
        dual: there are two opacities.
        backwards: from the back of the list to its front.
    """
    cuda, step, batch, rows = layout.lanes > 1, -1 if backwards else 1, BATCH, layout.rows
    opened, refilled = queue_functions(layout, backwards)
    length = HEADER + (channels if staged else 0)
    stride = _stride(length, dtype)
    words, per_word = -(-length * _size(dtype) // 16), 16 // _size(dtype)
    scalar, vector = ("float", "float4") if dtype is wp.float32 else ("double", "double2")
    header, record = HEADER, wp.types.vector(length, dtype)
    fields = "xyzw"[:per_word]

    def element(k: int) -> str:
        return f"r.c[{k}]" if k < length else f"({scalar})0"

    writes = "\n".join(
        f"p[{w}] = make_{vector}({', '.join(element(w * per_word + k) for k in range(per_word))});"
        for w in range(words)
    )
    reads = "\n".join(
        f"{{ const {vector} v = p[{w}]; "
        + " ".join(f"r.c[{w * per_word + k}] = v.{fields[k]};" for k in range(per_word) if w * per_word + k < length)
        + " }"
        for w in range(words)
    )
    locate = f"{vector}* p = ({vector}*)address + place * {stride // per_word};"
    floats = LANES_CUDA * stride
    word = wp.int32 if dtype is wp.float32 else wp.int64
    remaining = channels - first_channels
    vec2, vec3, vecC = (wp.types.vector(count, dtype) for count in (2, 3, channels))
    Splats = splats_type(first_channels, max(remaining, 1), dtype)
    response = alpha_functions(dtype)
    _, _, row = packed_root_functions(dtype)
    buffer = f"__shared__ __align__(16) {scalar} buffer[{layout.warps * floats}];"
    address_snippet = on_cuda(f"{buffer}\nreturn (wp::uint64)(buffer + warp * {floats});", "return 0;")
    put_snippet = on_cuda(f"{locate}\n{writes}")
    get_snippet = f"wp::vec_t<{length}, {scalar}> r;" + on_cuda(f"const {locate}\n{reads}") + "return r;"

    @wp.func_native(address_snippet)
    def records_of_warp(warp: int) -> wp.uint64: ...

    @wp.func_native(put_snippet)
    def put(address: wp.uint64, place: int, r: record): ...

    @wp.func_native(get_snippet)
    def get(address: wp.uint64, place: int) -> record: ...

    @wp.func
    def integer(x: dtype):
        return int(wp.cast(x, word))

    @wp.func
    def features_of(g: int, splats: Splats):
        f = vecC()
        first = splats.features[g]
        for c in range(first_channels):
            f[c] = first[c]
        if wp.static(remaining > 0):
            others = splats.rest[g]
            for c in range(remaining):
                f[first_channels + c] = others[c]
        return f

    @wp.func
    def store(walk: Walk, lane: int, middle: vec2, splats: Splats):
        """Writes the Gaussian of each lane to a record."""
        warp_sync()  # all lanes have walked the records before
        if lane < walk.count:
            g = walk.gaussian
            r = record()
            packed = row(splats.packed_roots, g)
            mean = response.from_middle(splats.means2d[g], packed, middle)
            root = response.in_units(packed)
            r[0] = mean[0]
            r[1] = mean[1]
            r[2] = root[0]
            r[3] = root[1]
            r[4] = root[2]
            r[5] = splats.opacities[g]
            if wp.static(dual):
                r[6] = splats.thermal_opacities[g]
            r[7] = wp.cast(word(walk.pair), dtype)
            r[8] = wp.cast(word(g), dtype)
            if wp.static(staged):
                f = features_of(g, splats)
                for c in range(channels):
                    r[header + c] = f[c]
            put(walk.records, lane, r)
        warp_sync()

    @wp.func
    def waiting(walk: Walk):
        """On the CPU: how many are walked before it is asked again whether any pixel goes on."""
        return wp.min(batch, wp.where(backwards, walk.candidate - walk.bound + 1, walk.bound - walk.candidate))

    @wp.func
    def begin(warp: int, lane: int, first: int, bound: int, pairs: SortedPairs):
        if wp.static(cuda):
            walk = opened(warp, lane, first, bound, pairs)
            walk.records = records_of_warp(warp)
            return refilled(walk, lane, pairs)
        walk = Walk()
        walk.candidate = first
        walk.bound = bound
        walk.count = waiting(walk)
        return walk

    @wp.func
    def go_on(walk: Walk, lane: int, middle: vec2, splats: Splats, pairs: SortedPairs):
        if wp.static(cuda):
            store(walk, lane, middle, splats)
            walk.taken += walk.count
            return refilled(walk, lane, pairs)
        walk.candidate += step * walk.count
        walk.count = waiting(walk)
        return walk

    @wp.func
    def gaussian(walk: Walk, pair: int, k: int, middle: vec2, y0: dtype, splats: Splats, pairs: SortedPairs):
        """The k-th; on the CPU the one of the pair, with rows from y0 on."""
        if wp.static(cuda):
            entry = get(walk.records, k)
            g = integer(entry[8])
            f = vecC()
            if wp.static(staged):
                for c in range(channels):
                    f[c] = entry[header + c]
            else:
                f = features_of(g, splats)
            mean, root = vec2(entry[0], entry[1]), vec3(entry[2], entry[3], entry[4])
            return integer(entry[7]), g, mean, root, entry[5], entry[6], f, 0, 1
        g = pairs.gaussian_ids[pair]
        packed = splats.packed_roots[g]
        mean = response.from_middle(splats.means2d[g], packed, middle)
        first, end = response.row_range(mean, splats.extents[g], y0, rows)
        f = features_of(g, splats)
        opacities = (splats.opacities[g], splats.thermal_opacities[g])
        return pair, g, mean, response.in_units(packed), opacities[0], opacities[1], f, first, end

    return WalkFunctions(begin, go_on, gaussian)
