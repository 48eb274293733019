"""How far apart along its ray the Gaussians lie that a pixel is made of (docs/thermosplat-plus.md, equation 16).

Before blending, log z and its square join each Gaussian's features; after it they are taken from the image again and
become the pixel's spread.
"""

import warp as wp

from warp_kernels.machinery.lane_sums import total_function
from warp_kernels.machinery.loading import made_once

NEAREST = 0.01
"""Near plane of the renderer [world units]: what is nearer is not drawn, and counts as lying there."""


@made_once
def moment_kernels(dtype: type, channels: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Features and log-depth of Gaussians.

    Args:
        channels: features of a Gaussian; a constant, so that all of them are read before any is awaited.

    Returns:
        ``(join_moments, join_moments_adjoint)``, one thread per Gaussian.
    """
    vec3 = wp.types.vector(3, dtype)
    nearest, two = dtype(NEAREST), dtype(2.0)

    @wp.func
    def depth(
        mean: vec3,
        viewmat: wp.array2d(dtype=dtype),  # [4, 4]
    ):
        return viewmat[2, 0] * mean[0] + viewmat[2, 1] * mean[1] + viewmat[2, 2] * mean[2] + viewmat[2, 3]

    @wp.kernel(name=f"join_moments_{channels}_{dtype.__name__}", enable_backward=False, module="unique")
    def join_kernel(
        first: int,
        features: wp.array2d(dtype=dtype),  # [N, d]
        means: wp.array(dtype=vec3),  # [N]
        viewmat: wp.array2d(dtype=dtype),  # [4, 4]
        # outputs
        joined: wp.array2d(dtype=dtype),  # [N, d + 2]
    ):
        gaussian = wp.tid() + first
        for c in range(wp.static(channels)):
            joined[gaussian, c] = features[gaussian, c]
        logarithm = wp.log(wp.max(depth(means[gaussian], viewmat), nearest))
        joined[gaussian, wp.static(channels)] = logarithm
        joined[gaussian, wp.static(channels + 1)] = logarithm * logarithm

    @wp.kernel(name=f"join_moments_adjoint_{channels}_{dtype.__name__}", enable_backward=False, module="unique")
    def join_adjoint_kernel(
        first: int,
        means: wp.array(dtype=vec3),  # [N]
        viewmat: wp.array2d(dtype=dtype),  # [4, 4]
        v_joined: wp.array2d(dtype=dtype),  # [N, d + 2]
        # outputs
        v_features: wp.array2d(dtype=dtype),  # [N, d]
        v_means: wp.array(dtype=vec3),  # [N]
    ):
        gaussian = wp.tid() + first
        for c in range(wp.static(channels)):
            v_features[gaussian, c] = v_joined[gaussian, c]
        z = depth(means[gaussian], viewmat)
        v_mean = vec3()
        if z > nearest:
            v_first = v_joined[gaussian, wp.static(channels)]
            v_second = v_joined[gaussian, wp.static(channels + 1)]
            v_z = (v_first + two * wp.log(z) * v_second) / z
            v_mean = v_z * vec3(viewmat[2, 0], viewmat[2, 1], viewmat[2, 2])
        v_means[gaussian] = v_mean

    return join_kernel, join_adjoint_kernel


@made_once
def spread_kernels(dtype: type, channels: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Features and spreads of pixels.

    Returns:
        ``(take_spreads, take_spreads_adjoint)``, one thread per pixel; the first is launched over ``whole_warps``.
    """
    zero, one, two = dtype(0.0), dtype(1.0), dtype(2.0)
    warp_total = total_function(dtype)

    @wp.kernel(name=f"take_spreads_{channels}_{dtype.__name__}", enable_backward=False, module="unique")
    def take_kernel(
        first: int,
        joined: wp.array2d(dtype=dtype),  # [pixels, d + 2]
        alphas: wp.array(dtype=dtype),  # [pixels]
        inverse_limit: dtype,
        share: dtype,
        lanes: int,
        # outputs
        features: wp.array2d(dtype=dtype),  # [pixels, d]
        parts: wp.array(dtype=dtype),  # [num_warps(pixels)]
    ):
        pixel = wp.tid() + first
        spread = zero
        if pixel < alphas.shape[0]:
            for c in range(wp.static(channels)):
                features[pixel, c] = joined[pixel, c]
            first_moment = joined[pixel, wp.static(channels)]
            v = alphas[pixel] * joined[pixel, wp.static(channels + 1)] - first_moment * first_moment
            spread = v / (one + v * inverse_limit)
        spread = warp_total(spread)
        if pixel % lanes == 0:
            parts[pixel // lanes] = share * spread

    @wp.kernel(name=f"take_spreads_adjoint_{channels}_{dtype.__name__}", enable_backward=False, module="unique")
    def take_adjoint_kernel(
        first: int,
        joined: wp.array2d(dtype=dtype),  # [pixels, d + 2]
        alphas: wp.array(dtype=dtype),  # [pixels]
        inverse_limit: dtype,
        share: dtype,
        v_features: wp.array2d(dtype=dtype),  # [pixels, d]
        v_spread: wp.array(dtype=dtype),  # [1]
        # outputs
        v_joined: wp.array2d(dtype=dtype),  # [pixels, d + 2]
        v_alphas: wp.array(dtype=dtype),  # [pixels]
    ):
        pixel = wp.tid() + first
        for c in range(wp.static(channels)):
            v_joined[pixel, c] = v_features[pixel, c]
        first_moment, second_moment = joined[pixel, wp.static(channels)], joined[pixel, wp.static(channels + 1)]
        alpha = alphas[pixel]
        damping = one + (alpha * second_moment - first_moment * first_moment) * inverse_limit
        v = share * v_spread[0] / (damping * damping)
        v_joined[pixel, wp.static(channels)] = -two * first_moment * v
        v_joined[pixel, wp.static(channels + 1)] = alpha * v
        v_alphas[pixel] = second_moment * v

    return take_kernel, take_adjoint_kernel
