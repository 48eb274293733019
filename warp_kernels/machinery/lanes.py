"""Warp-level cooperation of lanes, each helper with a CPU body that is the identity of a single lane.

A kernel that touches another lane's data only through these helpers runs with 32 lanes on CUDA and with one lane on
the CPU from the same source.
"""

import re

import warp as wp

from warp_kernels.machinery.loading import made_once

LANES_CUDA = 32


def on_cuda(source: str, otherwise: str = "") -> str:
    """A snippet that has its body on CUDA only."""
    return f"\n#if defined(__CUDA_ARCH__)\n{source}\n#else\n{otherwise}\n#endif\n"


def scalar_name(dtype: type) -> str:
    """What C++ calls a scalar."""
    return "float" if dtype is wp.float32 else "double"


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffffu, x);
#else
    return x;
#endif
""")
def warp_any(x: int) -> int: ...


# This, like warp_sum, is one instruction from compute capability 8.0 on.
@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    return x;
#elif __CUDA_ARCH__ >= 800
    return __reduce_max_sync(0xffffffffu, x);
#else
    for (int distance = 16; distance > 0; distance /= 2) {
        const int other = __shfl_xor_sync(0xffffffffu, x, distance);
        if (other > x) x = other;
    }
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
#if !defined(__CUDA_ARCH__)
    return x;
#elif __CUDA_ARCH__ >= 800
    return __reduce_add_sync(0xffffffffu, x);
#else
    for (int distance = 16; distance > 0; distance /= 2) x += __shfl_xor_sync(0xffffffffu, x, distance);
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


@made_once
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


def lanes_of(device: wp.Device) -> int:
    """Lanes of a warp."""
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


@made_once
def lane_functions(dtype: type):
    """Helpers that depend on the scalar type.

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


def whole_warps(count: int, device: wp.Device) -> int:
    """Threads to launch for so many rows: on CUDA full warps, whose last lanes pass row -1."""
    return num_warps(count, device) * LANES_CUDA if device.is_cuda else count


def num_warps(count: int, device: wp.Device) -> int:
    """Warps that have so many rows."""
    return -(-count // lanes_of(device))
