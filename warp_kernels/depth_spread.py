"""How far apart along its ray the Gaussians lie that a pixel is made of (docs/method.md, equation 16).

Before blending, log z and its square join each Gaussian's features; after it they are taken from the image again and
become the pixel's spread. A thread a number, so that rows of any width are read and written without gaps.
"""

import functools

import warp as wp

from warp_kernels.launching import launch

NEAREST = 0.01
"""Near plane of the renderer [world units]: what is nearer is not drawn, and counts as lying there."""


@functools.cache
def moment_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Features and log-depth of Gaussians.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(join_moments, join_moments_adjoint)``, one thread a number of ``joined``.
    """
    vec3 = wp.types.vector(3, dtype)
    nearest, one, two = dtype(NEAREST), dtype(1.0), dtype(2.0)

    @wp.func
    def depth(mean: vec3, viewmat: wp.array2d(dtype=dtype)):
        return viewmat[2, 0] * mean[0] + viewmat[2, 1] * mean[1] + viewmat[2, 2] * mean[2] + viewmat[2, 3]

    @wp.kernel(name=f"join_moments_{dtype.__name__}", enable_backward=False, module="unique")
    def join_kernel(
        first: int,
        features: wp.array2d(dtype=dtype),
        means: wp.array(dtype=vec3),
        viewmat: wp.array2d(dtype=dtype),
        # outputs
        joined: wp.array2d(dtype=dtype),
    ):
        number = wp.tid() + first
        row, column, channels = number // joined.shape[1], number % joined.shape[1], features.shape[1]
        if column < channels:
            joined[row, column] = features[row, column]
        else:
            logarithm = wp.log(wp.max(depth(means[row], viewmat), nearest))
            joined[row, column] = wp.where(column == channels, one, logarithm) * logarithm

    @wp.kernel(name=f"join_moments_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def join_adjoint_kernel(
        first: int,
        means: wp.array(dtype=vec3),
        viewmat: wp.array2d(dtype=dtype),
        v_joined: wp.array2d(dtype=dtype),
        # outputs
        v_features: wp.array2d(dtype=dtype),
        v_means: wp.array(dtype=vec3),
    ):
        number = wp.tid() + first
        row, column, channels = number // v_joined.shape[1], number % v_joined.shape[1], v_features.shape[1]
        if column < channels:
            v_features[row, column] = v_joined[row, column]
        elif column == channels:
            z = depth(means[row], viewmat)
            v_mean = vec3()
            if z > nearest:
                v_z = (v_joined[row, channels] + two * wp.log(z) * v_joined[row, channels + 1]) / z
                v_mean = v_z * vec3(viewmat[2, 0], viewmat[2, 1], viewmat[2, 2])
            v_means[row] = v_mean

    return join_kernel, join_adjoint_kernel


@functools.cache
def spread_kernels(dtype: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Features and spreads of pixels.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(take_spreads, take_spreads_adjoint)``, one thread a number of ``joined``.
    """
    one, two = dtype(1.0), dtype(2.0)

    @wp.func
    def spread(alpha: dtype, first_moment: dtype, second_moment: dtype):
        return alpha * second_moment - first_moment * first_moment

    @wp.kernel(name=f"take_spreads_{dtype.__name__}", enable_backward=False, module="unique")
    def take_kernel(
        first: int,
        joined: wp.array2d(dtype=dtype),
        alphas: wp.array(dtype=dtype),
        inverse_limit: dtype,
        # outputs
        features: wp.array2d(dtype=dtype),
        spreads: wp.array(dtype=dtype),
    ):
        number = wp.tid() + first
        row, column, channels = number // joined.shape[1], number % joined.shape[1], features.shape[1]
        if column < channels:
            features[row, column] = joined[row, column]
        elif column == channels:
            v = spread(alphas[row], joined[row, channels], joined[row, channels + 1])
            spreads[row] = v / (one + v * inverse_limit)

    @wp.kernel(name=f"take_spreads_adjoint_{dtype.__name__}", enable_backward=False, module="unique")
    def take_adjoint_kernel(
        first: int,
        joined: wp.array2d(dtype=dtype),
        alphas: wp.array(dtype=dtype),
        inverse_limit: dtype,
        v_features: wp.array2d(dtype=dtype),
        v_spread: wp.array(dtype=dtype),
        share: dtype,
        # outputs
        v_joined: wp.array2d(dtype=dtype),
        v_alphas: wp.array(dtype=dtype),
    ):
        number = wp.tid() + first
        row, column, channels = number // joined.shape[1], number % joined.shape[1], v_features.shape[1]
        if column < channels:
            v_joined[row, column] = v_features[row, column]
        else:
            first_moment, second_moment = joined[row, channels], joined[row, channels + 1]
            damping = one + spread(alphas[row], first_moment, second_moment) * inverse_limit
            v = share * v_spread[0] / (damping * damping)
            if column == channels:
                v_joined[row, column] = -two * first_moment * v
                v_alphas[row] = second_moment * v
            else:
                v_joined[row, column] = alphas[row] * v

    return take_kernel, take_adjoint_kernel


def join_moments(features: wp.array, means: wp.array, viewmat: wp.array, joined: wp.array) -> None:
    """Computes features beside log z and its square.

    Args:
        features: [N, d].
        means: vec3 [N] [world units].
        viewmat: [4, 4], world to camera.
        joined: [N, d + 2], output.
    """
    kernel, _ = moment_kernels(features.dtype)
    launch(kernel, joined.shape[0] * joined.shape[1], [features, means, viewmat, joined], features.device)


def join_moments_adjoint(
    means: wp.array, viewmat: wp.array, v_joined: wp.array, v_features: wp.array, v_means: wp.array
) -> None:
    """The gradients. They are written, not added to.

    Args:
        means: as in ``join_moments``.
        viewmat: as in ``join_moments``.
        v_joined: [N, d + 2].
        v_features: [N, d], output.
        v_means: vec3 [N], output.
    """
    _, kernel = moment_kernels(v_joined.dtype)
    launch(kernel, v_joined.shape[0] * v_joined.shape[1], [means, viewmat, v_joined, v_features, v_means], means.device)


def take_spreads(joined: wp.array, alphas: wp.array, limit: float, features: wp.array, spreads: wp.array) -> None:
    """Takes blended features and moments apart; of the moments it computes each pixel's v / (1 + v / limit).

    Args:
        joined: [pixels, d + 2].
        alphas: [pixels].
        limit: spread from which on more hardly counts; 0: no limit.
        features: [pixels, d], output.
        spreads: [pixels], output.
    """
    kernel, _ = spread_kernels(joined.dtype)
    inputs = [joined, alphas, _inverse(joined.dtype, limit), features, spreads]
    launch(kernel, joined.shape[0] * joined.shape[1], inputs, joined.device)


def take_spreads_adjoint(
    joined: wp.array,
    alphas: wp.array,
    limit: float,
    v_features: wp.array,
    v_spread: wp.array,
    share: float,
    v_joined: wp.array,
    v_alphas: wp.array,
) -> None:
    """The gradients, where every pixel's spread has the same one. They are written, not added to.

    Args:
        joined: as in ``take_spreads``.
        alphas: as in ``take_spreads``.
        limit: as in ``take_spreads``.
        v_features: [pixels, d].
        v_spread: [1].
        share: what ``v_spread`` is multiplied with: 1 / pixels where it is of the mean.
        v_joined: [pixels, d + 2], output.
        v_alphas: [pixels], output.
    """
    dtype = joined.dtype
    _, kernel = spread_kernels(dtype)
    inputs = [joined, alphas, _inverse(dtype, limit), v_features, v_spread, dtype(share), v_joined, v_alphas]
    launch(kernel, joined.shape[0] * joined.shape[1], inputs, joined.device)


def _inverse(dtype: type, limit: float):
    return dtype(1.0 / limit if limit > 0 else 0.0)
