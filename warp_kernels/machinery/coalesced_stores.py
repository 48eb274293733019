"""Stores of small vectors in as few memory transactions as their bytes need.

Warp stores a vector number by number: 32 neighbouring threads with a vec3 each touch every 32-byte sector of their 384
bytes three times, and the cache behind them takes one write for each touch. Of arrays that are written for every
Gaussian, seen or not, that is most of the time. Here a vec2 or vec4 is one store, and a warp's vec3s change lanes so
that neighbouring lanes write neighbouring numbers. float64, unaligned and scattered vectors are stored number by
number.
"""

import warp as wp

from warp_kernels.machinery.lanes import scalar_name
from warp_kernels.machinery.loading import made_once

STORE_VEC3 = """
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    const unsigned present = __ballot_sync(all, index >= 0);
    const int leader = __shfl_sync(all, index - lane, __ffs(present) - 1 & 31);
    if (sizeof(S) == 4 && __all_sync(all, index < 0 || index == leader + lane)) {
        S* numbers = (S*)(target.data + leader);
        #pragma unroll
        for (int at = lane; at < 96; at += 32) {
            const int from = at / 3, c = at - 3 * from;
            const S x = __shfl_sync(all, value[0], from);
            const S y = __shfl_sync(all, value[1], from);
            const S z = __shfl_sync(all, value[2], from);
            if (present >> from & 1) numbers[at] = c == 0 ? x : c == 1 ? y : z;
        }
        return;
    }
#endif
    if (index >= 0) target.data[index] = value;
"""


def _store_whole(length: int, dtype: type) -> str:
    """A vector of 2 or 4 numbers in one store, where they are float32 and aligned."""
    numbers = ", ".join(f"(float)value[{k}]" for k in range(length))
    return f"""
#if defined(__CUDA_ARCH__)
    if (sizeof({scalar_name(dtype)}) == 4 && ((size_t)target.data & {4 * length - 1}) == 0) {{
        *(float{length}*)(target.data + index) = make_float{length}({numbers});
        return;
    }}
#endif
    target.data[index] = value;
"""


@made_once
def store_functions(dtype: type):
    """Stores of vectors of 2, 3 and 4 numbers.

    Returns:
        ``(store2, store3, store4)``, Warp functions of an array, an index and a vector. On CUDA all lanes of a warp
        must call ``store3`` together; a lane with a negative index stores nothing.
    """
    vec2, vec3, vec4 = (wp.types.vector(k, dtype) for k in (2, 3, 4))

    @wp.func_native(_store_whole(2, dtype))
    def store2(target: wp.array(dtype=vec2), index: int, value: vec2): ...

    @wp.func_native(f"using S = {scalar_name(dtype)};{STORE_VEC3}")
    def store3(target: wp.array(dtype=vec3), index: int, value: vec3): ...

    @wp.func_native(_store_whole(4, dtype))
    def store4(target: wp.array(dtype=vec4), index: int, value: vec4): ...

    return store2, store3, store4
