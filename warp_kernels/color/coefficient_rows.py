"""The adjoint of a sum over one row of spherical harmonics coefficients a thread, moved by whole warps.

A Gaussian's coefficients are one row of up to 48 numbers (75 of degree 4), and so is their gradient: basis value times
colour gradient. Were each thread to read and write its own, neighbouring threads would do so 192 bytes apart. Where the
rows of a warp's 32 threads follow each other, as they do but at the end of an image, its lanes move some rows at a time
as one run, 4 numbers at once where nothing lies between rows, and each lane has its own row in shared memory. Rows that
nobody uses are only written. Other rows are read and written directly; on the CPU, where a warp is one lane, they all
are.

On CUDA all lanes of a warp must call the adjoint together: see ``lanes.whole_warps``. The sums themselves lose by this:
a thread has its own row's numbers in a few wide reads, and waits for nobody.
"""

import warp as wp

from warp_kernels.machinery.lanes import scalar_name
from warp_kernels.machinery.loading import made_once

BLOCK = 256
"""Threads a block on CUDA; Warp's default."""

# What varies, the scalar S, the most coefficients K and the threads of a block, is declared in front of the bodies.

ADJOINT = """
    wp::vec_t<K, S> v_b = {};
    const S zero = 0;
    const int count = rows.shape[1], held = count + lowest < K ? count + lowest : K;
    const int end = active < held ? active : held;
    if (count == 0) return v_b;
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const unsigned present = __ballot_sync(all, row >= 0), in_use = __ballot_sync(all, used);
    const int lane = threadIdx.x & 31, width = 3 * count, leader = __shfl_sync(all, row, 0);
    constexpr bool single = sizeof(S) == 4;
    constexpr int at_once = single ? 16 : 8;
    __shared__ __align__(16) S staged[block / 32][at_once * (3 * K | 1) + 96];
    S* numbers = staged[threadIdx.x >> 5];
    const int pitch = width | 1;  // odd, so that lanes meet in no bank
    const unsigned per_number = 0xffffffffu / width + 1;  // the row of number f is the high half of f times this
    const int source_pitch = rows.strides[0] / (int)sizeof(S), num_rows = __popc(present), read = 3 * (end - lowest);
    const S* source = (const S*)((const char*)rows.data + (long long)leader * rows.strides[0]);
    // Rows of an even width are apart in shared memory; 4 numbers at once must not be of two of them.
    const bool quads = single && width % 4 != 2;
    const bool reads_quads = quads && source_pitch == width && ((size_t)source & 15) == 0;
    const bool dense = width <= 3 * K && (count < 2 || rows.strides[1] == 3 * (int)sizeof(S));
    const bool together = __all_sync(all, dense && (row < 0 || row == leader + lane));
    if (add && !in_use) return v_b;
    if (together && (count < 2 || v_rows.strides[1] == rows.strides[1])) {
        const int target_pitch = v_rows.strides[0] / (int)sizeof(S);
        S* target = (S*)((char*)v_rows.data + (long long)leader * v_rows.strides[0]);
        const bool writes_quads = quads && target_pitch == width && !add && ((size_t)target & 15) == 0;
        // The gradients first, as the basis values are in registers until then. v waits in shared memory, or the
        // compiler would keep all products in registers, which both turns have in common.
        S* factors = numbers + at_once * (3 * K | 1) + 3 * lane;
        for (int c = 0; c < 3; ++c) factors[c] = used ? v[c] : zero;
        for (int first = 0; first < num_rows; first += at_once) {
            const int total = width * (num_rows - first < at_once ? num_rows - first : at_once);
            const unsigned wanted = in_use >> first & ((1u << at_once) - 1);
            if (wanted && lane >= first && lane < first + at_once) {
                S* own = numbers + (lane - first) * pitch - 3 * lowest;
                const S v0 = factors[0], v1 = factors[1], v2 = factors[2];
                #pragma unroll
                for (int k = 0; k < K + 1; ++k)
                    if (k >= lowest && k < count + lowest) {
                        const S scale = used && k < end ? b[k < K ? k : 0] : zero;
                        own[3 * k] = scale * v0;
                        own[3 * k + 1] = scale * v1;
                        own[3 * k + 2] = scale * v2;
                    }
            }
            __syncwarp();
            S* to = target + first * target_pitch;
            int f = lane;
            if (writes_quads) {
                #pragma unroll 3
                for (f = 4 * lane; f + 3 < total; f += 128) {
                    const S* s = numbers + f + (int)__umulhi(f, per_number) * (pitch - width);
                    float4 quad = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
                    if (wanted) quad = make_float4((float)s[0], (float)s[1], (float)s[2], (float)s[3]);
                    __stcs((float4*)(to + f), quad);
                }
                f = (total & ~3) + lane;
            }
            for (; f < total; f += 32) {
                const int r = __umulhi(f, per_number), e = f - r * width;
                if (add && !(wanted >> r & 1)) continue;
                S* gradient = to + r * target_pitch + e;
                const S value = wanted ? numbers[r * pitch + e] : zero;
                *gradient = add ? *gradient + value : value;
            }
            __syncwarp();
        }
        for (int first = 0; first < num_rows && end > 1; first += at_once) {
            const int total = width * (num_rows - first < at_once ? num_rows - first : at_once);
            const unsigned wanted = in_use >> first & ((1u << at_once) - 1);
            if (!wanted) continue;
            const S* from = source + first * source_pitch;
            int f = lane;
            if (reads_quads) {
                #pragma unroll 3
                for (f = 4 * lane; f + 3 < total; f += 128) {
                    const int r = __umulhi(f, per_number), e = f - r * width;
                    if ((e < read && (wanted >> r & 1)) || (e + 3 >= width && (wanted >> (r + 1) & 1))) {
                        const float4 quad = __ldg((const float4*)(from + f));
                        S* to = numbers + f + r * (pitch - width);
                        to[0] = quad.x; to[1] = quad.y; to[2] = quad.z; to[3] = quad.w;
                    }
                }
                f = (total & ~3) + lane;
            }
            for (; f < total; f += 32) {
                const int r = __umulhi(f, per_number), e = f - r * width;
                if (e < read && (wanted >> r & 1)) numbers[r * pitch + e] = from[r * source_pitch + e];
            }
            __syncwarp();
            if (used && lane >= first && lane < first + at_once) {
                const S* own = numbers + (lane - first) * pitch - 3 * lowest;
                #pragma unroll
                for (int k = 1; k < K; ++k)
                    if (k < end) v_b[k] = own[3 * k] * v[0] + own[3 * k + 1] * v[1] + own[3 * k + 2] * v[2];
            }
            __syncwarp();
        }
        return v_b;
    }
#endif
    if (row < 0) return v_b;
    const char* mine = (const char*)rows.data + (long long)row * rows.strides[0];
    char* target = (char*)v_rows.data + (long long)row * v_rows.strides[0];
    #pragma unroll
    for (int k = 0; k < K; ++k)
        if (k >= lowest && k < held) {
            const S* coefficient = (const S*)(mine + (k - lowest) * rows.strides[1]);
            S* gradient = (S*)(target + (k - lowest) * v_rows.strides[1]);
            const bool counts = used && k < end;
            if (counts && k > 0) v_b[k] = coefficient[0] * v[0] + coefficient[1] * v[1] + coefficient[2] * v[2];
            for (int c = 0; c < 3; ++c) {
                const S value = counts ? b[k] * v[c] : zero;
                if (!add || counts) gradient[c] = add ? gradient[c] + value : value;
            }
        }
    if (!add)
        for (int k = held; k < count + lowest; ++k) {
            S* gradient = (S*)(target + (k - lowest) * v_rows.strides[1]);
            for (int c = 0; c < 3; ++c) gradient[c] = zero;
        }
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
        constexpr int Q = (3 * K + 3) / 4;
        float4 quads[Q];
        #pragma unroll
        for (int j = 0; j < Q; ++j)
            if (4 * j < end) quads[j] = __ldg((const float4*)mine + j);
        #pragma unroll
        for (int j = 0; j < Q; ++j)
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
    for (int k = 0; k < K; ++k)
        if (k >= lowest && k < active) {
            const S* coefficient = (const S*)(mine + (k - lowest) * rows.strides[1]);
            for (int c = 0; c < 3; ++c) total[c] += b[k] * coefficient[c];
        }
    return total;
"""


@made_once
def row_sum_function(dtype: type, most: int):
    """A row's sum.

    Args:
        most: coefficients that may be active.

    Returns:
        ``row_sum(rows, lowest, row, b, active, start)``: start + Σ b[k] rows[row, k - lowest] over lowest <= k <
        active, where rows begin with the coefficient ``lowest``, 0 or 1.
    """
    vec3, vecK = wp.types.vector(3, dtype), wp.types.vector(most, dtype)

    @wp.func_native(f"using S = {scalar_name(dtype)}; constexpr int K = {most};{SUM}")
    def row_sum(rows: wp.array2d(dtype=vec3), lowest: int, row: int, b: vecK, active: int, start: vec3) -> vec3: ...

    return row_sum


@made_once
def row_adjoint_function(dtype: type, most: int):
    """The adjoint of Σ b[k] rows[row, k - lowest] over lowest <= k < active.

    Args:
        most: coefficients that may be active.

    Returns:
        ``row_adjoint(rows, v_rows, lowest, row, b, v, active, used, add)``, where rows begin with the coefficient
        ``lowest``, 0 or 1: adds b[k] v to v_rows[row, k - lowest], or with ``add`` false overwrites the row, and
        returns the dot products of rows[row, k - lowest] with v, by k; that of 0, whose basis is constant, is left out.
        A row that is not ``used`` is not read and has a gradient of zero.
    """
    vec3, vecK = wp.types.vector(3, dtype), wp.types.vector(most, dtype)

    @wp.func_native(f"using S = {scalar_name(dtype)}; constexpr int K = {most}, block = {BLOCK};{ADJOINT}")
    def row_adjoint(
        rows: wp.array2d(dtype=vec3),
        v_rows: wp.array2d(dtype=vec3),
        lowest: int,
        row: int,
        b: vecK,
        v: vec3,
        active: int,
        used: bool,
        add: bool,
    ) -> vecK: ...

    return row_adjoint
