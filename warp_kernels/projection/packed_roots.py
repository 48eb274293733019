"""The fourth number beside a root (u, k, v): what rounding took from the Gaussian's position in the image.

Positions in float32 are up to 2e-6 px off at 40 px and 2e-4 px at 8,000 px, which is most of all errors of images and
gradients. The remainder has two numbers, but an array of their own would cost the blending a memory access for every
pair, a quarter more than it has. So both are whole numbers of ``STEP`` in the bits of one float, and root and
remainders are 16 bytes that are read at once. float64 needs no remainders.
"""

import warp as wp

from warp_kernels.machinery.lanes import scalar_name
from warp_kernels.machinery.loading import made_once

STEP = 2.0**-25
"""[px]: 1/60 of the rounding at 40 px."""

MOST = 2**14
"""Steps of the largest remainder of a position below 16,384 px; of farther ones as much is kept."""

LARGEST_UPPER = 0x7F7F
"""Upper half of the largest finite float."""

LOAD_ROW = """
#if defined(__CUDA_ARCH__)
    if (sizeof(S) == 4 && ((size_t)rows.data & 15) == 0) {
        const float4 quad = __ldg((const float4*)rows.data + index);
        return wp::vec_t<4, S>((S)quad.x, (S)quad.y, (S)quad.z, (S)quad.w);
    }
#endif
    return rows.data[index];
"""


@made_once
def packed_root_functions(dtype: type):
    """Warp functions for one type.

    Returns:
        ``(pack, unpack, row)``: a remainder as one number, and back; root and remainder of a Gaussian.
    """
    vec2, vec4 = wp.types.vector(2, dtype), wp.types.vector(4, dtype)
    single = dtype is wp.float32
    step, per_step, most = wp.float32(STEP), wp.float32(1.0 / STEP), wp.float32(MOST)

    @wp.func
    def steps(x: dtype):
        return wp.int32(wp.round(wp.clamp(wp.float32(x) * per_step, -most, most)))

    @wp.func
    def pack(remainder: vec2):
        result = dtype(0.0)
        if wp.static(single):
            # The upper half is kept positive and below infinity's bits, so that it is a number whoever copies it.
            upper = wp.min(steps(remainder[0]) + MOST, LARGEST_UPPER)
            result = wp.cast((upper << 16) | (steps(remainder[1]) & 65535), wp.float32)
        return result

    @wp.func
    def unpack(packed: dtype):
        result = vec2()
        if wp.static(single):
            bits = wp.cast(packed, wp.int32)
            result = step * vec2(wp.float32((bits >> 16) - MOST), wp.float32((bits << 16) >> 16))
        return result

    @wp.func_native(f"using S = {scalar_name(dtype)};{LOAD_ROW}")
    def row(rows: wp.array(dtype=vec4), index: int) -> vec4: ...

    return pack, unpack, row
