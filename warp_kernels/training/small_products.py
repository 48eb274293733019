"""Products of many small matrices, each with three columns: libraries are made for large ones, and slow here."""

from typing import Any

import warp as wp

from warp_kernels.machinery.loading import made_once


@made_once
def small_product_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels, one thread for each row of a product, which has three numbers.

    Returns:
        ``(multiply, multiply_transposed)``.
    """
    vec3: Any = wp.types.vector(3, dtype)

    @wp.kernel(name=f"small_product_{dtype.__name__}", enable_backward=False, module="unique")
    def multiply_kernel(
        first: int,
        matrices: wp.array3d(dtype=dtype),  # [N, K, K]
        columns: wp.array2d(dtype=vec3),  # [N, K]
        # outputs
        products: wp.array2d(dtype=vec3),  # [N, K]
    ):
        number = wp.tid() + first
        n = number // columns.shape[1]
        row = number - n * columns.shape[1]
        total = vec3()
        for k in range(columns.shape[1]):
            total += matrices[n, row, k] * columns[n, k]
        products[n, row] = total

    @wp.kernel(name=f"small_product_transposed_{dtype.__name__}", enable_backward=False, module="unique")
    def multiply_transposed_kernel(
        first: int,
        matrices: wp.array3d(dtype=dtype),  # [N, K, K]
        columns: wp.array2d(dtype=vec3),  # [N, K]
        # outputs
        products: wp.array2d(dtype=vec3),  # [N, K]
    ):
        number = wp.tid() + first
        n = number // columns.shape[1]
        row = number - n * columns.shape[1]
        total = vec3()
        for k in range(columns.shape[1]):
            total += matrices[n, k, row] * columns[n, k]
        products[n, row] = total

    return multiply_kernel, multiply_transposed_kernel
