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
from warp_kernels.blending.blend_layout import BlendLayout
from warp_kernels.machinery.lanes import LANES_CUDA, on_cuda, warp_sync
from warp_kernels.machinery.loading import made_once
from warp_kernels.machinery.warp_lists import list_functions
from warp_kernels.projection.packed_roots import packed_root_functions

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
        dtype: ``wp.float32`` or ``wp.float64``.
        layout: deal of pixels to lanes.

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


class QueueFunctions(NamedTuple):
    """Warp functions of a warp's queue of places in the list.

    Attributes:
        queue_of_warp: the address of a warp's queue.
        block_parts: the mask of its block.
        mask_of: the mask of a place within the list.
        refill: queues places until a warp's worth waits or none is left, given how many were taken from the queue and
            put into it, where the next 32 candidates begin, the mask of this lane's, and the list's ``bound`` (forwards
            the first place behind it, backwards its first place).
        take: takes up to 32: how many, and this lane's place and Gaussian.
    """

    queue_of_warp: Any
    block_parts: Any
    mask_of: Any
    refill: Any
    take: Any


@made_once
def queue_functions(layout: BlendLayout, backwards: bool) -> QueueFunctions:
    """From the masks of a list to the places of the pairs that reach a warp's block, in the list's order or against it.

    Args:
        layout: deal of pixels to lanes.
        backwards: from the back of the list to its front.

    Returns:
        The functions.
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
    def refill(
        queue: wp.uint64,
        lane: int,
        parts: int,
        taken: int,
        put: int,
        candidates: int,
        mask: int,
        bound: int,
        masks: wp.array(dtype=wp.uint8),  # [pairs]
    ):
        end = int(put)
        first = int(candidates)
        own = int(mask)
        warp_sync()  # all lanes have read what they took
        while end - taken < LANES_CUDA and within(first, bound):
            end = append(queue, end, lane, (own & parts) != 0, first + step * lane)
            first += step * LANES_CUDA
            own = mask_of(first + step * lane, bound, masks)
        warp_sync()
        return end, first, own

    @wp.func
    def take(
        queue: wp.uint64,
        lane: int,
        taken: int,
        put: int,
        gaussian_ids: wp.array(dtype=wp.int32),  # [pairs]
    ):
        count = wp.min(put - taken, LANES_CUDA)
        place = int(0)
        gaussian = int(0)
        if lane < count:
            place = item(queue, taken + lane)
            gaussian = gaussian_ids[place]
        return count, place, gaussian

    return QueueFunctions(queue_of_warp, block_parts, mask_of, refill, take)


class RecordFunctions(NamedTuple):
    """Warp functions of the records that a warp keeps in shared memory.

    Attributes:
        features_of: the features of a Gaussian.
        records_of_warp: the address of a warp's records.
        store: stores the Gaussians of the first ``count`` lanes.
        get: reads one.
        integer: the whole number that stands in one.
    """

    features_of: Any
    records_of_warp: Any
    store: Any
    get: Any
    integer: Any


@made_once
def record_functions(
    channels: int, first_channels: int, staged: bool, dual: bool, dtype: type, layout: BlendLayout
) -> RecordFunctions:
    """From the Gaussian that a lane took to the warp's records.

    Args:
        channels: C, features of a Gaussian.
        first_channels: of these, those that lie in an array of their own; C: all lie in one.
        staged: records hold them.
        dual: there are two opacities.
        dtype: ``wp.float32`` or ``wp.float64``.
        layout: deal of pixels to lanes.

    Returns:
        The functions.
    """
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
    vec2, vec4, vecC = (wp.types.vector(count, dtype) for count in (2, 4, channels))
    vecA, vecB = wp.types.vector(first_channels, dtype), wp.types.vector(max(remaining, 1), dtype)
    response = alpha_functions(dtype, layout)
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
    def features_of(
        g: int,
        features: wp.array(dtype=vecA),  # [images · N]
        rest: wp.array(dtype=vecB),  # [images · N]; [0]: there are no other channels
    ):
        f = vecC()
        first = features[g]
        for c in range(first_channels):
            f[c] = first[c]
        if wp.static(remaining > 0):
            others = rest[g]
            for c in range(remaining):
                f[first_channels + c] = others[c]
        return f

    @wp.func
    def store(
        address: wp.uint64,
        lane: int,
        count: int,
        place: int,
        g: int,
        middle: vec2,
        means2d: wp.array(dtype=vec2),  # [images · N]
        packed_roots: wp.array(dtype=vec4),  # [images · N]
        opacities: wp.array(dtype=dtype),  # [images · N]
        thermal_opacities: wp.array(dtype=dtype),  # [images · N]
        features: wp.array(dtype=vecA),  # [images · N]
        rest: wp.array(dtype=vecB),  # [images · N]; [0]: there are no other channels
    ):
        warp_sync()  # all lanes have walked the records before
        if lane < count:
            r = record()
            packed = row(packed_roots, g)
            mean = response.from_middle(means2d[g], packed, middle)
            root = response.in_units(packed)
            r[0] = mean[0]
            r[1] = mean[1]
            r[2] = root[0]
            r[3] = root[1]
            r[4] = root[2]
            r[5] = opacities[g]
            if wp.static(dual):
                r[6] = thermal_opacities[g]
            r[7] = wp.cast(word(place), dtype)
            r[8] = wp.cast(word(g), dtype)
            if wp.static(staged):
                f = features_of(g, features, rest)
                for c in range(channels):
                    r[header + c] = f[c]
            put(address, lane, r)
        warp_sync()

    return RecordFunctions(features_of, records_of_warp, store, get, integer)
