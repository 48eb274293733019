"""The adjoint of a sum over one row of spherical harmonics coefficients a thread, moved by whole warps.

A Gaussian's coefficients are one row of up to 48 numbers, and so is their gradient: basis value times colour gradient.
Were each thread to write its own, neighbouring threads would write 192 bytes apart. Where the rows of a warp's 32
threads follow each other, as they do but at the end of an image, its lanes walk all of them as one run: the basis
values and colour gradients lie in shared memory, a row nobody uses is only written, and 4 numbers are written at once
where nothing lies between rows. Other rows are read and written directly; on the CPU, where a warp is one lane, they
all are.

On CUDA all lanes of a warp must call the adjoint together: see ``whole_warps``.
"""

import functools

import warp as wp

from warp_kernels.lanes import scalar_name

BLOCK = 256
"""Threads a block on CUDA; Warp's default."""

# What varies, the scalar S and the threads of a block, is declared in front of the bodies.

ADJOINT = """
    wp::vec_t<16, S> v_b = {};
    const S zero = 0;
    const int count = rows.shape[1], held = count + lowest < 16 ? count + lowest : 16;
    const int end = active < held ? active : held;
    bool together = false;
#if defined(__CUDA_ARCH__)
    __shared__ S staged_values[block / 32][32 * 17];
    __shared__ S staged_v[block / 32][32 * 3];
    const unsigned all = 0xffffffffu;
    const unsigned present = __ballot_sync(all, row >= 0), in_use = __ballot_sync(all, used);
    if (count == 0 || (add && !in_use)) return v_b;
    const int lane = threadIdx.x & 31, width = 3 * count, count_rows = __popc(present);
    const int leader = __shfl_sync(all, row, 0);
    const bool dense = count < 2 || (rows.strides[1] == 3 * (int)sizeof(S) && v_rows.strides[1] == rows.strides[1]);
    together = __all_sync(all, dense && (row < 0 || row == leader + lane));
    S* all_values = staged_values[threadIdx.x >> 5];
    S* all_v = staged_v[threadIdx.x >> 5];
    S* values = all_values + lane * 17;  // this lane's; an odd distance apart, so that lanes meet in no bank
    if (in_use) {
        #pragma unroll
        for (int k = 0; k < 16; ++k) values[k] = used && k < end ? b[k] : zero;
        #pragma unroll
        for (int c = 0; c < 3; ++c) all_v[lane * 3 + c] = used ? v[c] : zero;
        __syncwarp();
    }
    if (together) {
        // Gradients: a sweep of the warp writes `sweep` numbers; this lane's are those from `e` of row `r` on.
        const int pitch = v_rows.strides[0] / (int)sizeof(S), total = width * count_rows;
        S* target = (S*)((char*)v_rows.data + (long long)leader * v_rows.strides[0]);
        const bool wide = sizeof(S) == 4 && pitch == width && !add && ((size_t)target & 15) == 0;
        const int sweep = wide ? 128 : 32, next_r = sweep / width, next_e = sweep % width;
        int r = lane * (sweep / 32) / width, e = lane * (sweep / 32) % width;
        for (int f = lane * (sweep / 32); f < total; f += sweep) {
            if (wide) {
                float quad[4] = {0.0f, 0.0f, 0.0f, 0.0f};
                if (in_use) {
                    int row_at = r, at = e;
                    #pragma unroll
                    for (int j = 0; j < 4; ++j) {
                        const int k = at / 3;
                        if (k + lowest < 16 && f + j < total)
                            quad[j] = (float)(all_values[row_at * 17 + k + lowest] * all_v[row_at * 3 + at - 3 * k]);
                        if (++at == width) { at = 0; ++row_at; }
                    }
                }
                if (f + 3 < total) *(float4*)(target + f) = make_float4(quad[0], quad[1], quad[2], quad[3]);
                else
                    for (int j = 0; f + j < total; ++j) target[f + j] = quad[j];
            } else if (!add || in_use >> r & 1) {
                const int k = e / 3;
                const bool any = in_use && k + lowest < 16;
                const S value = any ? all_values[r * 17 + k + lowest] * all_v[r * 3 + e - 3 * k] : zero;
                S* gradient = target + r * pitch + e;
                *gradient = add ? *gradient + value : value;
            }
            r += next_r;
            e += next_e;
            if (e >= width) { e -= width; ++r; }
        }
        // Dot products, in the places of the basis values.
        if (in_use && end > 1) {
            __syncwarp();
            const S* source = (const S*)((const char*)rows.data + (long long)leader * rows.strides[0]);
            const int pitch = rows.strides[0] / (int)sizeof(S), products = end - 1;
            const int next_r = 32 / products, next_k = 32 % products;
            int r = lane / products, k = lane % products + 1;
            #pragma unroll 4
            for (int item = lane; item < products * count_rows; item += 32) {
                const S *c = source + r * pitch + (k - lowest) * 3, *w = all_v + r * 3;
                if (in_use >> r & 1) all_values[r * 17 + k] = c[0] * w[0] + c[1] * w[1] + c[2] * w[2];
                r += next_r;
                k += next_k;
                if (k >= end) { k -= products; ++r; }
            }
            __syncwarp();
        }
    }
#else
    S values[16];
    for (int k = 0; k < 16; ++k) values[k] = b[k];
#endif
    if (row >= 0 && !together) {
        const char* mine = (const char*)rows.data + (long long)row * rows.strides[0];
        char* target = (char*)v_rows.data + (long long)row * v_rows.strides[0];
        const int written = used ? end : lowest;
        #pragma unroll 1
        for (int k = lowest; k < written; ++k) {
            const S* coefficient = (const S*)(mine + (k - lowest) * rows.strides[1]);
            S* gradient = (S*)(target + (k - lowest) * v_rows.strides[1]);
            for (int c = 0; c < 3; ++c) gradient[c] = add ? gradient[c] + values[k] * v[c] : values[k] * v[c];
            values[k] = coefficient[0] * v[0] + coefficient[1] * v[1] + coefficient[2] * v[2];
        }
        if (!add)
            #pragma unroll 1
            for (int k = written; k < count + lowest; ++k) {
                S* gradient = (S*)(target + (k - lowest) * v_rows.strides[1]);
                for (int c = 0; c < 3; ++c) gradient[c] = zero;
            }
    }
    if (used)
        #pragma unroll
        for (int k = 1; k < 16; ++k)
            if (k < end) v_b[k] = values[k];
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
    return v_b;
"""


# A row's numbers 4 at a time where its memory allows that, all asked for before the first is used.
SUM = """
    wp::vec_t<3, S> total = start;
    const char* mine = (const char*)rows.data + (long long)row * rows.strides[0];
#if defined(__CUDA_ARCH__)
    const bool aligned = (((size_t)rows.data | rows.strides[0]) & 15) == 0 && rows.strides[1] == 12;
    if (sizeof(S) == 4 && lowest == 0 && aligned) {
        const int end = 3 * active;
        float4 quads[12];
        #pragma unroll
        for (int j = 0; j < 12; ++j)
            if (4 * j < end) quads[j] = __ldg((const float4*)mine + j);
        #pragma unroll
        for (int j = 0; j < 12; ++j)
            if (4 * j < end) {
                const float numbers[4] = {quads[j].x, quads[j].y, quads[j].z, quads[j].w};
                #pragma unroll
                for (int i = 0; i < 4; ++i) {
                    const int at = 4 * j + i;
                    if (at < end) total[at % 3] += b[at / 3] * (S)numbers[i];
                }
            }
        return total;
    }
#endif
    #pragma unroll
    for (int k = 0; k < 16; ++k)
        if (k >= lowest && k < active) {
            const S* coefficient = (const S*)(mine + (k - lowest) * rows.strides[1]);
            for (int c = 0; c < 3; ++c) total[c] += b[k] * coefficient[c];
        }
    return total;
"""


def whole_warps(count: int, device: wp.Device) -> int:
    """Threads to launch for so many rows: on CUDA full warps, whose last lanes pass row -1.

    Args:
        count: Rows.
        device: Where.
    """
    return -(-count // 32) * 32 if device.is_cuda else count


@functools.cache
def row_sum_function(dtype: type):
    """A row's sum.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``row_sum(rows, lowest, row, b, active, start)``: start + Σ b[k] rows[row, k - lowest] over lowest <= k <
        active, where rows begin with the coefficient ``lowest``, 0 or 1.
    """
    vec3, vec16 = wp.types.vector(3, dtype), wp.types.vector(16, dtype)

    @wp.func_native(f"using S = {scalar_name(dtype)};{SUM}")
    def row_sum(rows: wp.array2d(dtype=vec3), lowest: int, row: int, b: vec16, active: int, start: vec3) -> vec3: ...

    return row_sum


@functools.cache
def row_adjoint_function(dtype: type):
    """The adjoint of Σ b[k] rows[row, k - lowest] over lowest <= k < active.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``row_adjoint(rows, v_rows, lowest, row, b, v, active, used, add)``, where rows begin with the coefficient
        ``lowest``, 0 or 1: adds b[k] v to v_rows[row, k - lowest], or with ``add`` false overwrites the row, and
        returns the dot products of rows[row, k - lowest] with v, by k; that of 0, whose basis is constant, is left out.
        A row that is not ``used`` is not read and has a gradient of zero.
    """
    vec3, vec16 = wp.types.vector(3, dtype), wp.types.vector(16, dtype)

    @wp.func_native(f"using S = {scalar_name(dtype)}; constexpr int block = {BLOCK};{ADJOINT}")
    def row_adjoint(
        rows: wp.array2d(dtype=vec3),
        v_rows: wp.array2d(dtype=vec3),
        lowest: int,
        row: int,
        b: vec16,
        v: vec3,
        active: int,
        used: bool,
        add: bool,
    ) -> vec16: ...

    return row_adjoint
