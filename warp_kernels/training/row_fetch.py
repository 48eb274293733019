"""The first numbers of some rows, fetched from where rows are padded; the host's memory, for one."""

import warp as wp

THREADS = 2**30
"""Threads of a launch, at most: they have numbers of 32 bits."""

QUAD = 4
"""Numbers of a thread: a warp reads 512 bytes of rows that follow each other."""


@wp.func_native("""
    const float* p = rows.data + (size_t)row * rows.shape[1] + column;
#if defined(__CUDA_ARCH__)
    if (((size_t)p & 15) == 0) {
        const float4 all = *(const float4*)p;
        return wp::vec_t<4, float>(all.x, all.y, all.z, all.w);
    }
#endif
    return wp::vec_t<4, float>(p[0], p[1], p[2], p[3]);
""")
def load_numbers(rows: wp.array2d(dtype=wp.float32), row: int, column: int) -> wp.vec4:
    """Four numbers of a row, in one piece where they are aligned."""
    ...


@wp.kernel(name="row_fetch", enable_backward=False, module="unique")
def row_fetch_kernel(
    first: wp.int64,
    quads: int,
    indices: wp.array(dtype=wp.int64),  # [n]
    rows: wp.array2d(dtype=wp.float32),  # [N, L]
    # outputs
    values: wp.array2d(dtype=wp.float32),  # [n, used]
):
    """Four numbers of a row; threads that follow each other share it."""
    number = first + wp.int64(wp.tid())
    place = int(number / wp.int64(quads))
    column = wp.static(QUAD) * int(number - wp.int64(place) * wp.int64(quads))
    found = load_numbers(rows, int(indices[place]), column)
    for k in range(wp.static(QUAD)):
        if column + k < values.shape[1]:
            values[place, column + k] = found[k]
