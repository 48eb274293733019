"""The candidates of a warp that reach its pixel block, kept in shared memory while the warp walks them.

Of 32 candidates, one a lane, each lane whose candidate passed the test writes its record to the place of its rank. The
walk then reads records one after the other, all lanes the same one: addresses are known beforehand, so that the
latency of one Gaussian's numbers hides behind the arithmetic of another, and the numbers of all survivors were fetched
from memory at once. CUDA only; on the CPU a lane reads what it needs from the arrays.
"""

import functools
from typing import Any

import warp as wp

from warp_kernels.alpha import alpha_functions
from warp_kernels.blend_layout import BlendLayout
from warp_kernels.lanes import LANES_CUDA, count_bits, on_cuda, warp_ballot, warp_sync

HEADER = 9
"""Numbers before the features: mean2d (2), root (3), opacity, thermal opacity, lane of the candidate, its index."""

SHARED_BYTES = 40 * 1024
"""Shared memory for records; a block of threads has 48 KiB without asking for more, some of which Warp takes."""


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


@functools.cache
def survivor_functions(
    channels: int, first_channels: int, staged: bool, dual: bool, dtype: type, layout: BlendLayout
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """From a lane's candidate to the warp's records.

    Args:
        channels: C, features of a Gaussian.
        first_channels: of these, those that lie in an array of their own; C: all lie in one.
        staged: records hold them.
        dual: there are two opacities.
        dtype: ``wp.float32`` or ``wp.float64``.
        layout: deal of pixels to lanes.

    Returns:
        Warp functions ``(candidate, features_of, records_of_warp, admit, get, integer)``: the numbers of a Gaussian;
        its features; the address of a warp's records; store each lane's candidate that reaches the warp's block, whose
        first pixel centre is (x0, y0), and count them; read one; the whole number in one of its places.
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
    vec2, vec3, vecC = (wp.types.vector(count, dtype) for count in (2, 3, channels))
    vecA, vecB = wp.types.vector(first_channels, dtype), wp.types.vector(max(remaining, 1), dtype)
    _, _, reaches_block, _ = alpha_functions(dtype)
    across, down, zero = dtype(layout.block_width - 1), dtype(layout.block_height - 1), dtype(0.0)
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
    def candidate(
        g: int,
        means2d: wp.array(dtype=vec2),
        roots: wp.array(dtype=vec3),
        opacities: wp.array(dtype=dtype),
        thermal_opacities: wp.array(dtype=dtype),
    ):
        mean = means2d[g]
        root = roots[g]
        opacity = opacities[g]
        opacity_t = zero
        if wp.static(dual):
            opacity_t = thermal_opacities[g]
        return mean, root, opacity, opacity_t

    @wp.func
    def features_of(g: int, features: wp.array(dtype=vecA), rest: wp.array(dtype=vecB)):
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
    def admit(
        address: wp.uint64,
        lane: int,
        candidates: int,
        x0: dtype,
        y0: dtype,
        g: int,
        mean: vec2,
        root: vec3,
        opacity: dtype,
        opacity_t: dtype,
        features: wp.array(dtype=vecA),
        rest: wp.array(dtype=vecB),
    ):
        hit = int(0)
        if lane < candidates:
            bound = opacity
            if wp.static(dual):
                bound = wp.max(opacity, opacity_t)
            hit = wp.where(reaches_block(mean, root, bound, x0, y0, x0 + across, y0 + down), 1, 0)
        survivors = warp_ballot(hit)
        warp_sync()
        if hit != 0:
            r = record()
            r[0] = mean[0]
            r[1] = mean[1]
            r[2] = root[0]
            r[3] = root[1]
            r[4] = root[2]
            r[5] = opacity
            r[6] = opacity_t
            r[7] = wp.cast(word(lane), dtype)
            r[8] = wp.cast(word(g), dtype)
            if wp.static(staged):
                f = features_of(g, features, rest)
                for c in range(channels):
                    r[header + c] = f[c]
            below = (wp.uint32(1) << wp.uint32(lane)) - wp.uint32(1)
            put(address, count_bits(survivors & below), r)
        warp_sync()
        return count_bits(survivors)

    return candidate, features_of, records_of_warp, admit, get, integer
