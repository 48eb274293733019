"""Warp-level cooperation of lanes, each helper with a CPU body that is the identity of a single lane.

A kernel that touches another lane's data only through these helpers runs with 32 lanes on CUDA and with one lane on
the CPU from the same source.
"""

import functools
import re
from collections.abc import Sequence

import warp as wp

LANES_CUDA = 32


def on_cuda(source: str, otherwise: str = "") -> str:
    """A snippet that has its body on CUDA only.

    Args:
        source: the body.
        otherwise: what stands there on the CPU.
    """
    return f"\n#if defined(__CUDA_ARCH__)\n{source}\n#else\n{otherwise}\n#endif\n"


def scalar_name(dtype: type) -> str:
    """What C++ calls a scalar.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.
    """
    return "float" if dtype is wp.float32 else "double"


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, x);
#else
    return x;
#endif
""")
def warp_any(x: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __reduce_max_sync(0xffffffffu, x);
#else
    return x;
#endif
""")
def warp_max(x: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, x);
#else
    return x ? 1u : 0u;
#endif
""")
def warp_ballot(x: int) -> wp.uint32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(x);
#else
    return __builtin_popcount(x);
#endif
""")
def count_bits(x: wp.uint32) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __reduce_add_sync(0xffffffffu, x);
#else
    return x;
#endif
""")
def warp_sum(x: wp.uint32) -> wp.uint32: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int distance = 1; distance < 32; distance *= 2) {
        const int before = __shfl_up_sync(0xffffffffu, x, distance);
        if ((threadIdx.x & 31) >= distance) x += before;
    }
#endif
    return x;
""")
def warp_scan(x: int) -> int: ...


@functools.cache
def shuffle_function(dtype: type):
    """What lanes read each other's numbers by; all of a warp together.

    Args:
        dtype: ``wp.int32``, ``wp.float32`` or ``wp.float64``.

    Returns:
        A Warp function (value, lane): that lane's value.
    """

    @wp.func_native(on_cuda("return __shfl_sync(0xffffffffu, x, source);", "return x;"))
    def shuffle(x: dtype, source: int) -> dtype: ...

    return shuffle


warp_shuffle = shuffle_function(wp.int32)


@functools.cache
def total_function(dtype: type):
    """A sum over all lanes of a warp, which all call it together; always in the same order.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        A Warp function of one number.
    """
    halvings = "for (int distance = 16; distance > 0; distance /= 2) x += __shfl_xor_sync(0xffffffffu, x, distance);"

    @wp.func_native(on_cuda(halvings) + "return x;")
    def warp_total(x: dtype) -> dtype: ...

    return warp_total


def lanes_of(device: wp.Device) -> int:
    """Lanes of a warp.

    Args:
        device: where.
    """
    return LANES_CUDA if device.is_cuda else 1


# The first lane whose ``end`` is above ``item``, by halving; the last one where there is none. Ends rise from lane to
# lane.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
    int owner = 0;
    for (int step = 16; step > 0; step /= 2) {
        if (__shfl_sync(0xffffffffu, end, owner + step - 1) <= item) owner += step;
    }
    return owner;
#else
    return 0;
#endif
""")
def warp_owner(end: int, item: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def warp_sync(): ...


# Branch-free on the CPU, so that a loop over pixels vectorises (a call into libm does not). Valid for x <= 0, which is
# all the blend needs. x = n + f exactly, then a polynomial of f ln 2, fitted for the least relative error on half of
# ln 2 to either side: relative error 1e-7 for the x at which anything is drawn. CUDA's instruction is as good (2 ulp).
EXP2_NEGATIVE_F32 = """
#if defined(__CUDA_ARCH__)
    float r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
#else
    float y = x < -126.0f ? -126.0f : x;
    float n = ::floorf(y + 0.5f);
    float f = (y - n) * 0.69314718f;
    float p = 1.3814467e-3f;
    p = p * f + 8.3687806e-3f;
    p = p * f + 4.1668394e-2f;
    p = p * f + 1.6666520e-1f;
    p = p * f + 0.49999993f;
    p = (p * f) * f + f + 1.0f;
    union { int i; float f; } u;
    u.i = ((int)n + 127) << 23;
    return p * u.f;
#endif
"""
EXP2_NEGATIVE_F64 = "return ::exp2(x);"

# t (1 - a) rounded once: over thousands of layers the roundings of 1 - a and of a product add up. A processor without a
# fused multiply-add (x86 before 2013) would call a function for it, which does not vectorise.
ATTENUATE = """
#if defined(__CUDA_ARCH__)
    return ::FMA(-a, t, t);
#elif defined(__FMA__) || defined(__aarch64__)
    return __builtin_FMA(-a, t, t);
#else
    return t * (1 - a);
#endif
"""

# The hardware's estimate (1 ulp) and a Newton step, which rounds almost always as a division does: a division proper
# branches, for numbers that are hardly larger than 0 or infinite.
RECIPROCAL_F32 = """
#if defined(__CUDA_ARCH__)
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return ::fmaf(::fmaf(-x, r, 1.0f), r, r);
#else
    return 1.0f / x;
#endif
"""
RECIPROCAL_F64 = "return 1.0 / x;"


def accumulate_snippet(length: int, dtype: type, *, apart: Sequence[tuple[str, int, int]] | None = None) -> str:
    """Source of a native function that sums a vector over the warp and stores it in ``dst[index]``, or adds it there.

    A transposed butterfly leaves component ``l`` in lane ``l``: for a power of two of components one shuffle a
    component, and one more for each halving that is left to 32, instead of 5 a component; then one coalesced access
    for up to 32. Other lengths are cut into powers of two. CUDA only: on the CPU a warp is one lane.

    Args:
        length: Components of the vector.
        dtype: ``wp.float32`` or ``wp.float64``.
        apart: None: one warp owns the place and stores all components there. Otherwise several warps meet: components
            are added atomically, those of these half-open ranges to ``array[index]`` of the array of that name, the
            others side by side to ``dst[index]``.

    Returns:
        C++ source using the arguments ``dst`` and those that ``apart`` names (arrays of vectors), ``index``, ``lane``
        and ``v``.
    """
    scalar = scalar_name(dtype)
    lines = [f"{scalar}* p = ({scalar}*)(dst.data + index);"]
    pieces, removed, behind = [], 0, 0
    for array, begin, end in apart or ():
        lines.append(f"{scalar}* of_{array} = ({scalar}*)({array}.data + index) - {begin};")
        pieces += [(begin, f"p + k - {removed}")] * (begin > behind) + [(end, f"of_{array} + k")]
        removed, behind = removed + end - begin, end
    at = f"p + k - {removed}"
    for end, place in reversed(pieces):
        at = f"k < {end} ? {place} : {at}"
    for start in range(0, length, 32):
        end, first = min(start + 32, length), start
        lines.append(f"{{ {scalar} total = ({scalar})0;")
        for width in butterfly_widths(end - start):
            lines += _butterfly(width, first, end, scalar)
            lines.append(f"if (lane >= {first - start}) total = r[0]; }}")
            first += width
        write = "p[k] = total;" if apart is None else f"atomicAdd(({at}), total);"
        lines.append(f"const int k = {start} + lane; if (lane < {end - start}) {write} }}")
    return "\n#if defined(__CUDA_ARCH__)\n" + "\n".join(lines) + "\n#endif\n"


@functools.cache
def butterfly_widths(count: int) -> tuple[int, ...]:
    """Powers of two, falling, that cover ``count`` components with the fewest shuffles; the last may be partly empty.

    Args:
        count: 0 to 32.

    Returns:
        The widths.
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
        dtype: ``wp.float32`` or ``wp.float64``.

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


@functools.cache
def lane_functions(dtype: type):
    """Helpers that depend on the scalar type.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(exp2_negative, attenuate, reciprocal)``: 2^x for x <= 0, t (1 - a), 1 / x for ordinary x > 0.
    """

    @wp.func_native(EXP2_NEGATIVE_F32 if dtype is wp.float32 else EXP2_NEGATIVE_F64)
    def exp2_negative(x: dtype) -> dtype: ...

    @wp.func_native(re.sub(r"FMA(?=\()", "fmaf" if dtype is wp.float32 else "fma", ATTENUATE))
    def attenuate(t: dtype, a: dtype) -> dtype: ...

    @wp.func_native(RECIPROCAL_F32 if dtype is wp.float32 else RECIPROCAL_F64)
    def reciprocal(x: dtype) -> dtype: ...

    return exp2_negative, attenuate, reciprocal
