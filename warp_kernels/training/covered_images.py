"""Decoded images as far as Gaussians cover them: base + α · decoded, and its adjoint, one pass over the pixels each."""

import warp as wp

from warp_kernels.machinery.loading import made_once


@made_once
def covering_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels, one thread per pixel.

    Returns:
        ``(cover, cover_adjoint)``.
    """

    @wp.kernel(name=f"cover_{dtype.__name__}", enable_backward=False, module="unique")
    def cover_kernel(
        first: int,
        decoded: wp.array2d(dtype=dtype),  # [pixels, C]
        alphas: wp.array(dtype=dtype),  # [pixels]
        base: wp.array2d(dtype=dtype),  # [pixels, C]; [0, C]: zeros
        # outputs
        covered: wp.array2d(dtype=dtype),  # [pixels, C]
    ):
        pixel = wp.tid() + first
        alpha = alphas[pixel]
        for c in range(decoded.shape[1]):
            value = alpha * decoded[pixel, c]
            if base.shape[0] > 0:
                value = value + base[pixel, c]
            covered[pixel, c] = value

    @wp.kernel(name=f"cover_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def cover_adjoint_kernel(
        first: int,
        decoded: wp.array2d(dtype=dtype),  # [pixels, C]
        alphas: wp.array(dtype=dtype),  # [pixels]
        v_covered: wp.array2d(dtype=dtype),  # [pixels, C]
        # outputs
        v_decoded: wp.array2d(dtype=dtype),  # [pixels, C]
        v_alphas: wp.array(dtype=dtype),  # [pixels]
    ):
        pixel = wp.tid() + first
        alpha = alphas[pixel]
        total = dtype(0.0)
        for c in range(decoded.shape[1]):
            v = v_covered[pixel, c]
            total += v * decoded[pixel, c]
            v_decoded[pixel, c] = alpha * v
        v_alphas[pixel] = total

    return cover_kernel, cover_adjoint_kernel
