"""The adjoint of a sum over one row of spherical harmonics coefficients a thread, moved by whole warps.

A Gaussian's coefficients above degree 0 are one row of up to 45 numbers, and so is their gradient. Were each thread to
write its own, neighbouring threads would write 180 bytes apart. Where the rows of a warp's 32 threads follow each
other, as they do but at the end of an image, its lanes move all of them together through shared memory; float64 and
other rows are read and written directly. On the CPU, where a warp is one lane, rows are always. (The sum itself reads
a row directly: a line stays in the cache while its numbers are read one after the other, and nothing is written.)

On CUDA all lanes of a warp must call the adjoint together: see ``whole_warps``.
"""

import functools
import re

import warp as wp

HIGHEST = 15
"""Coefficients above degree 0, at most."""

BLOCK = 256
"""Threads a block on CUDA; Warp's default."""

# Every lane's row, side by side, in `staged`; `mine` is this lane's, there or in memory. `row` is negative in a lane
# behind the last row.
STAGED = """
    __shared__ float staged_rows[BLOCK_ / 32][32 * 3 * HIGHEST_];
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31, width = 3 * rows.shape[1];
    const int first = __shfl_sync(all, row, 0);
    const bool fits = width <= 3 * HIGHEST_ && DENSE_ && (row < 0 || row == first + lane);
    const bool together = sizeof(S_) == sizeof(float) && __all_sync(all, fits);
    const unsigned present = __ballot_sync(all, row >= 0), in_use = __ballot_sync(all, used);
    const int count_rows = __popc(present);
    S_* staged = (S_*)staged_rows[threadIdx.x >> 5];
    const S_* mine = (const S_*)((const char*)rows.data + (long long)row * rows.strides[0]);
    int step = rows.strides[1] / (int)sizeof(S_);
    if (together) {
        mine = staged + lane * width;
        step = 3;
        if (active > 1 && in_use) {
            const S_* source = (const S_*)((const char*)rows.data + (long long)first * rows.strides[0]);
            MOVE_(rows, in_use, staged[to] = source[at])
            __syncwarp();
        }
    }
"""

# Whether a row's numbers lie side by side.
DENSE = "({0}.shape[1] < 2 || {0}.strides[1] == 3 * (int)sizeof(S_))"

# The numbers of the warp's rows in `wanted`, between `at` in memory and `to` in `staged`: where most rows are, and
# nothing lies between them (the degree 0 of the next may), in one sweep, and else row by row.
MOVE = """
    if ({rows}.strides[0] == width * (int)sizeof(S_) && 2 * __popc({wanted}) >= count_rows) {{
        for (int at = lane; at < width * count_rows; at += 32) {{ const int to = at; {what}; }}
    }} else {{
        const int pitch = {rows}.strides[0] / (int)sizeof(S_);
        #pragma unroll 4
        for (int r = 0; r < count_rows; ++r)
            if ({wanted} >> r & 1)
                for (int e = lane; e < width; e += 32) {{ const int at = r * pitch + e, to = r * width + e; {what}; }}
    }}
"""

ADJOINT = """
    wp::vec_t<16, S_> v_b = {};
    const S_ zero = 0;
    const int count = rows.shape[1];
#if defined(__CUDA_ARCH__)
    STAGED_
    if (used) {
        #pragma unroll
        for (int k = 1; k <= HIGHEST_; ++k)
            if (k < active) {
                const S_* coefficient = mine + (k - 1) * step;
                v_b[k] = coefficient[0] * v[0] + coefficient[1] * v[1] + coefficient[2] * v[2];
            }
    }
    if (together) {
        S_* target = (S_*)((char*)v_rows.data + (long long)first * v_rows.strides[0]);
        if (in_use) {
            __syncwarp();
            #pragma unroll
            for (int k = 1; k <= HIGHEST_; ++k)
                if (k <= count)
                    for (int c = 0; c < 3; ++c)
                        staged[lane * width + (k - 1) * 3 + c] = k < active && used ? b[k] * v[c] : zero;
            __syncwarp();
            if (add) {
                MOVE_(v_rows, in_use, target[at] += staged[to])
            } else {
                MOVE_(v_rows, present, target[at] = staged[to])
            }
            __syncwarp();
        } else if (!add) {
            MOVE_(v_rows, present, target[at] = zero)
        }
    }
    const bool written_above = together;
#else
    const bool written_above = false;
    if (used) {
        const char* mine = (const char*)rows.data + (long long)row * rows.strides[0];
        for (int k = 1; k < active; ++k) {
            const S_* coefficient = (const S_*)(mine + (k - 1) * rows.strides[1]);
            v_b[k] = coefficient[0] * v[0] + coefficient[1] * v[1] + coefficient[2] * v[2];
        }
    }
#endif
    if (row >= 0 && !written_above) {
        char* target = (char*)v_rows.data + (long long)row * v_rows.strides[0];
        const int written = used ? active : 1;
        #pragma unroll
        for (int k = 1; k <= HIGHEST_; ++k)
            if (k < written) {
                S_* gradient = (S_*)(target + (k - 1) * v_rows.strides[1]);
                for (int c = 0; c < 3; ++c) gradient[c] = add ? gradient[c] + b[k] * v[c] : b[k] * v[c];
            }
        if (!add)
            for (int k = written; k <= count; ++k) {
                S_* gradient = (S_*)(target + (k - 1) * v_rows.strides[1]);
                for (int c = 0; c < 3; ++c) gradient[c] = zero;
            }
    }
    return v_b;
"""


def whole_warps(count: int, device: wp.Device) -> int:
    """Threads to launch for so many rows: on CUDA full warps, whose last lanes pass row -1.

    Args:
        count: Rows.
        device: Where.
    """
    return -(-count // 32) * 32 if device.is_cuda else count


@functools.cache
def row_adjoint_function(dtype: type):
    """The adjoint of Σ b[k] rows[row, k - 1] over 0 < k < active.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``row_adjoint(rows, v_rows, row, b, v, active, used, add)``: adds b[k] v to v_rows[row, k - 1], or with ``add``
        false overwrites the row, and returns the dot products of rows[row, k - 1] with v, by k. A row that is not
        ``used`` has a gradient of zero, whatever it holds.
    """
    vec3, vec16 = wp.types.vector(3, dtype), wp.types.vector(16, dtype)
    dense = f"{DENSE.format('rows')} && {DENSE.format('v_rows')}"

    @wp.func_native(_source(ADJOINT, dtype, dense))
    def row_adjoint(
        rows: wp.array2d(dtype=vec3),
        v_rows: wp.array2d(dtype=vec3),
        row: int,
        b: vec16,
        v: vec3,
        active: int,
        used: bool,
        add: bool,
    ) -> vec16: ...

    return row_adjoint


def _source(snippet: str, dtype: type, dense: str) -> str:
    """A snippet with its placeholders filled in."""
    snippet = snippet.replace("STAGED_", STAGED)
    snippet = re.sub(
        r"MOVE_\((\w+), (\w+), (.*)\)\n", lambda m: MOVE.format(rows=m[1], wanted=m[2], what=m[3]), snippet
    )
    words = {
        "DENSE_": dense,
        "HIGHEST_": str(HIGHEST),
        "BLOCK_": str(BLOCK),
        "S_": "float" if dtype is wp.float32 else "double",
    }
    for word, value in words.items():
        snippet = snippet.replace(word, value)
    return snippet
