"""Adam's update of some rows of a parameter; the others and their moments stay as they are.

Parameter and moments may lie in the host's memory, pinned: the device then reads and writes these rows over the bus.
The two moments of a number lie beside each other, and rows are padded, so that the threads of a warp read and write
whole lines of 128 bytes. The values of the rows come beside their gradient, since whoever had a gradient for them has
fetched them already.
"""

import warp as wp

THREADS = 2**30
"""Threads of a launch, at most: they have numbers of 32 bits."""

LINE = 4
"""Pairs of numbers whose moments fill 64 bytes: rows are updated in multiples of these."""


@wp.func_native("""
    const wp::vec_t<4, float>* p = (const wp::vec_t<4, float>*)(rows.data + (size_t)row * rows.shape[1]) + place;
#if defined(__CUDA_ARCH__)
    if (((size_t)p & 15) == 0) {
        const float4 all = *(const float4*)p;
        return wp::vec_t<4, float>(all.x, all.y, all.z, all.w);
    }
#endif
    return *p;
""")
def load_moments(rows: wp.array2d(dtype=wp.vec4), row: int, place: int) -> wp.vec4:
    """Moments (m, v, m, v) of two numbers of a row, in one piece."""
    ...


@wp.func_native("""
    wp::vec_t<4, float>* p = rows.data + (size_t)row * rows.shape[1] + place;
#if defined(__CUDA_ARCH__)
    if (((size_t)p & 15) == 0) {
        *(float4*)p = make_float4(values[0], values[1], values[2], values[3]);
        return;
    }
#endif
    *p = values;
""")
def store_moments(rows: wp.array2d(dtype=wp.vec4), row: int, place: int, values: wp.vec4):
    """Overwrites moments (m, v, m, v) of two numbers of a row, in one piece."""
    ...


@wp.func_native("""
    float* p = rows.data + (size_t)row * rows.shape[1] + column;
#if defined(__CUDA_ARCH__)
    if (count == 2 && ((size_t)p & 7) == 0) {
        *(float2*)p = make_float2(values[0], values[1]);
        return;
    }
#endif
    for (int k = 0; k < count; ++k) p[k] = values[k];
""")
def store_numbers(rows: wp.array2d(dtype=wp.float32), row: int, column: int, count: int, values: wp.vec2):
    """Overwrites no, one or two numbers of a row, in one piece where they are aligned."""
    ...


@wp.kernel(name="row_adam_update", enable_backward=False, module="unique")
def row_adam_kernel(
    first: wp.int64,
    pairs: int,
    used: int,
    length: int,
    share1: wp.float32,
    beta2: wp.float32,
    share2: wp.float32,
    epsilon: wp.float32,
    blocked: wp.array(dtype=wp.float32),  # [1]
    coefficients: wp.array(dtype=wp.vec3),  # [1]
    indices: wp.array(dtype=wp.int64),  # [n]
    values: wp.array2d(dtype=wp.float32),  # [n, used]
    gradients: wp.array2d(dtype=wp.float32),  # [n, used]
    # inputs and outputs
    near: wp.array2d(dtype=wp.vec4),  # [R, L / 2]
    far: wp.array2d(dtype=wp.vec4),  # [N, L / 2]
    # outputs
    parameter: wp.array2d(dtype=wp.float32),  # [N, K], or with padded rows [N, L]
):
    """Moments and parameter of two numbers; threads that follow each other share a row. Moments of the first R rows are
    those in ``near``. Behind ``used`` moments stay as they are, and so does the parameter, but for the padding."""
    # moments are (m, v, m, v) of two numbers: near of the first R rows, far of the others; L is a multiple of 8
    if blocked[0] != 0.0:
        return
    number = first + wp.int64(wp.tid())
    place = int(number / wp.int64(pairs))
    pair = int(number - wp.int64(place) * wp.int64(pairs))
    row = int(indices[place])
    is_near = row < near.shape[0]
    moments = wp.vec4()
    if is_near:
        moments = load_moments(near, row, pair)
    else:
        moments = load_moments(far, row, pair)
    c = coefficients[0]
    updated = wp.vec2()
    count = int(0)
    for k in range(2):
        column = 2 * pair + k
        if column < used:
            g = gradients[place, column]
            m = moments[2 * k]
            v = moments[2 * k + 1]
            m = m + share1 * (g - m)
            v = beta2 * v + share2 * g * g
            moments[2 * k] = m
            moments[2 * k + 1] = v
            updated[k] = c[2] * values[place, column] - c[0] * m / (wp.sqrt(v) / c[1] + epsilon)
        if count == k and (column < used or (column >= length and column < parameter.shape[1])):
            count = k + 1
    if is_near:
        store_moments(near, row, pair, moments)
    else:
        store_moments(far, row, pair, moments)
    store_numbers(parameter, row, 2 * pair, count, updated)
