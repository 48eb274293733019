"""One launch over the numbers of many float32 tensors, whose addresses and sizes are arguments of the kernel.

A model has a score of parameters, some of them small; a launch for each leaves the device idle between them. As
arguments, addresses can be captured in a graph, and nothing is copied to the device for them.
"""

import struct
from collections.abc import Iterator, Sequence
from typing import Any

import warp as wp

PLACES = 32
"""Tensors of a launch, at most."""

QUAD = 4
"""Numbers of a thread."""

BLOCK = 256
"""Each tensor begins with a new block of threads, so that the threads of a warp do the same."""

THREADS = 2**31 - 1
"""Threads of a launch, at most: they are numbered with 32 bits."""

_pack = struct.Struct(f"{PLACES}Q").pack

Addresses = wp.types.vector(PLACES, wp.uint64)
Counts = wp.types.vector(PLACES, wp.uint64)  # of int32 nvcc would copy a table to every thread's stack


@wp.func
def share_of(ends: Counts, thread: int):
    """The tensor that a thread belongs to, by the ends of their threads, and the first number of the thread's share."""
    place = int(0)
    while place < wp.static(PLACES - 1) and thread >= int(ends[place]):
        place += 1
    start = int(0)
    if place > 0:
        start = int(ends[place - 1])
    return place, wp.static(QUAD) * (thread - start)


@wp.func_native("""
    const float* p = (const float*)address + first;
    wp::vec_t<4, float> values = {};
#if defined(__CUDA_ARCH__)
    if (size - first >= 4 && ((unsigned long long)p & 15) == 0) {
        const float4 all = *(const float4*)p;
        values[0] = all.x; values[1] = all.y; values[2] = all.z; values[3] = all.w;
        return values;
    }
#endif
    for (int k = 0; k < 4; ++k)
        if (k < size - first) values[k] = p[k];
    return values;
""")
def load_quad(address: wp.uint64, first: int, size: int) -> wp.vec4:
    """Numbers first to first + 3 of a tensor; zeros behind its end."""
    ...


@wp.func_native("""
    float* p = (float*)address + first;
#if defined(__CUDA_ARCH__)
    if (size - first >= 4 && ((unsigned long long)p & 15) == 0) {
        *(float4*)p = make_float4(values[0], values[1], values[2], values[3]);
        return;
    }
#endif
    for (int k = 0; k < 4; ++k)
        if (k < size - first) p[k] = values[k];
""")
def store_quad(address: wp.uint64, first: int, size: int, values: wp.vec4):
    """Overwrites numbers first to first + 3 of a tensor, as far as it goes."""
    ...


def addresses(tensors: Sequence[wp.array]) -> Addresses:
    """A table of float32 arrays.

    Args:
        tensors: at most PLACES, without gaps.
    """
    return _filled(Addresses, [tensor.ptr or 0 for tensor in tensors])


def counts(values: Sequence[int]) -> Counts:
    """A table of numbers."""
    return _filled(Counts, values)


def _filled(kind: type, values: Sequence[int]) -> Any:
    """A vector whose last numbers are 0; made from bytes in a tenth of the time that its constructor takes."""
    return kind.from_buffer_copy(_pack(*values, *[0] * (PLACES - len(values))))


def launches(sizes: Sequence[int]) -> Iterator[tuple[slice, list[int]]]:
    """The launches that go over all tensors.

    Args:
        sizes: numbers in each tensor, below 2**31.

    Yields:
        The tensors of a launch, and where each one's threads end; the last is the number of threads to launch.
    """
    first, ends = 0, [0]
    for place, size in enumerate(sizes):
        threads = -(-size // (QUAD * BLOCK)) * BLOCK
        if place - first == PLACES or ends[-1] + threads > THREADS:
            yield slice(first, place), ends[1:]
            first, ends = place, [0]
        ends.append(ends[-1] + threads)
    if len(ends) > 1:
        yield slice(first, len(sizes)), ends[1:]
