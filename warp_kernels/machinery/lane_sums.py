"""Sums over the lanes of a warp, of one number or of a vector, and on the CPU over the rows of a matrix."""

import functools
from collections.abc import Sequence

import warp as wp

from warp_kernels.machinery.lanes import on_cuda, scalar_name
from warp_kernels.machinery.loading import made_once


@made_once
def total_function(dtype: type):
    """A sum over all lanes of a warp, which all call it together; always in the same order."""
    halvings = "for (int distance = 16; distance > 0; distance /= 2) x += __shfl_xor_sync(0xffffffffu, x, distance);"

    @wp.func_native(on_cuda(halvings) + "return x;")
    def warp_total(x: dtype) -> dtype: ...

    return warp_total


@made_once
def lane_sum_function(length: int):
    """A sum of float64 vectors over all lanes of a warp, which all call it together; always in the same order.

    Returns:
        A Warp function (sums, row, lane, vector) that stores the sum in ``sums[row]``; on the CPU, the vector itself.
    """
    vector = wp.types.vector(length, wp.float64)
    source = accumulate_snippet(length, wp.float64) + on_cuda("", "dst.data[index] = v;")

    @wp.func_native(source)
    def store_lane_sum(dst: wp.array(dtype=vector), index: int, lane: int, v: vector): ...

    return store_lane_sum


def accumulate_snippet(length: int, dtype: type, *, apart: Sequence[tuple[str, int, int]] | None = None) -> str:
    """Source of a native function that sums a vector over the warp and stores it in ``dst[index]``, or adds it there.

    A transposed butterfly leaves component ``l`` in lane ``l``: for a power of two of components one shuffle a
    component, and one more for each halving that is left to 32, instead of 5 a component; then one coalesced access
    for up to 32. Other lengths are cut into powers of two. CUDA only: on the CPU a warp is one lane.

    Args:
        apart: None: one warp owns the place and stores all components there. Otherwise several warps meet: components
            are added atomically, those of these half-open ranges to ``array[index]`` of the array of that name, the
            others side by side to ``dst[index]``.

    Returns:
        C++ source using the arguments ``dst`` and those that ``apart`` names (arrays of vectors), ``index``, ``lane``
        and ``v``.
    """
    scalar = scalar_name(dtype)
    lines, places = [], []
    if apart is None or sum(end - begin for _, begin, end in apart) < length:
        lines.append(f"{scalar}* p = ({scalar}*)(dst.data + index);")
    removed, behind = 0, 0
    for array, begin, end in apart or ():
        lines.append(f"{scalar}* of_{array} = ({scalar}*)({array}.data + index) - {begin};")
        places += [(behind, begin, f"p + k - {removed}"), (begin, end, f"of_{array} + k")]
        removed, behind = removed + end - begin, end
    places.append((behind, length, f"p + k - {removed}"))
    for start in range(0, length, 32):
        end, first = min(start + 32, length), start
        lines.append(f"{{ {scalar} total = ({scalar})0;")
        for width in butterfly_widths(end - start):
            lines += _butterfly(width, first, end, scalar)
            lines.append(f"if (lane >= {first - start}) total = r[0]; }}")
            first += width
        *others, (*_, at) = [place for place in places if max(place[0], start) < min(place[1], end)]
        for _, place_end, place in reversed(others):
            at = f"k < {place_end} ? {place} : {at}"
        write = "p[k] = total;" if apart is None else f"atomicAdd(({at}), total);"
        lines.append(f"const int k = {start} + lane; if (lane < {end - start}) {write} }}")
    return "\n#if defined(__CUDA_ARCH__)\n" + "\n".join(lines) + "\n#endif\n"


@functools.cache
def butterfly_widths(count: int) -> tuple[int, ...]:
    """Powers of two, falling, that cover ``count`` components with the fewest shuffles; the last may be partly empty.

    Args:
        count: 0 to 32.
    """
    if count <= 0:
        return ()
    options = [(width, *butterfly_widths(count - width)) for width in (1, 2, 4, 8, 16, 32) if width < 2 * count]
    falling = [option for option in options if list(option) == sorted(option, reverse=True)]
    return min(falling, key=lambda option: sum(w - 1 + (32 // w).bit_length() - 1 for w in option))


def _butterfly(width: int, first: int, end: int, scalar: str) -> list[str]:
    """Opens a block in which ``r[0]`` is the sum over the warp of component ``first + lane % width``."""
    values = ", ".join(f"v[{k}]" if k < end else f"({scalar})0" for k in range(first, first + width))
    lines = [f"{{ {scalar} r[{width}] = {{ {values} }};"]
    half = width // 2
    while half >= 1:
        lines.append(f"{{ const bool upper = (lane & {half}) != 0;")
        for k in range(half):
            lines.append(
                f"{{ const {scalar} keep = upper ? r[{k + half}] : r[{k}], send = upper ? r[{k}] : r[{k + half}]; "
                f"r[{k}] = keep + __shfl_xor_sync(0xffffffffu, send, {half}); }}"
            )
        lines.append("}")
        half //= 2
    distance = width
    while distance < 32:
        lines.append(f"r[0] += __shfl_xor_sync(0xffffffffu, r[0], {distance});")
        distance *= 2
    return lines


def column_sums_snippet(length: int, columns: int, dtype: type) -> str:
    """Source of a native CPU function that sums each row of a matrix, as many rows at once as a vector has numbers.

    Summing one vector takes as many shuffles as halvings, and does nothing but shuffle. Folding two rows into one
    vector by halves, then two of those, and so on, leaves every row's sum in a lane of its own for a quarter of that.

    Args:
        length: Rows.
        columns: Columns, a power of two.

    Returns:
        C++ source using the arguments ``m`` (matrix) and ``out`` (array of vectors of ``length``), and ``index``.
    """
    scalar = scalar_name(dtype)
    width = min(columns, 16)
    lines = [f"typedef {scalar} V __attribute__((ext_vector_type({width})));"]
    lines.append(f"typedef V Unaligned __attribute__((aligned(sizeof({scalar}))));")
    lines.append(f"{scalar}* p = ({scalar}*)(out.data + index);")
    for first in range(0, length, width):
        count = min(width, length - first)
        names = []
        for k in range(width):
            parts = [f"*(const Unaligned*)&m.data[{first + k}][{c}]" for c in range(0, columns, width)]
            value = " + ".join(parts) if k < count else "(V)0"
            names.append(f"r{first}_{k}")
            lines.append(f"V {names[-1]} = {value};")
        segment = width
        while len(names) > 1:
            half = segment // 2
            low = [s + i for s in range(0, 2 * width, segment) for i in range(half)]
            folded = []
            for one, other in zip(names[::2], names[1::2], strict=True):
                folded.append(f"{one}_{segment}")
                picks = [", ".join(str(lane + shift) for lane in low) for shift in (0, half)]
                halves = [f"__builtin_shufflevector({one}, {other}, {pick})" for pick in picks]
                lines.append(f"V {folded[-1]} = {halves[0]} + {halves[1]};")
            names, segment = folded, half
        lines += [f"p[{first + k}] = {names[0]}[{k}];" for k in range(count)]
    return "\n#if !defined(__CUDA_ARCH__)\n" + "\n".join(lines) + "\n#endif\n"
