"""Decoded images as far as Gaussians cover them: base + α · decoded, and its adjoint, one pass over the pixels each."""

import warp as wp

from warp_kernels.machinery.launching import launch
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


def cover(decoded: wp.array, alphas: wp.array, base: wp.array, covered: wp.array) -> None:
    """Computes base + α · decoded.

    Args:
        decoded: [pixels, C].
        alphas: [pixels].
        base: [pixels, C], any strides; [0, C]: zeros.
        covered: [pixels, C], output.
    """
    kernel, _ = covering_kernels(decoded.dtype)
    launch(kernel, decoded.shape[0], [decoded, alphas, base, covered], decoded.device)


def cover_adjoint(
    decoded: wp.array, alphas: wp.array, v_covered: wp.array, v_decoded: wp.array, v_alphas: wp.array
) -> None:
    """The gradients; that of the base is ``v_covered`` itself. The other arguments are those of ``cover``.

    Args:
        v_covered: [pixels, C].
        v_decoded: [pixels, C], output.
        v_alphas: [pixels], output.
    """
    _, kernel = covering_kernels(decoded.dtype)
    launch(kernel, decoded.shape[0], [decoded, alphas, v_covered, v_decoded, v_alphas], decoded.device)
