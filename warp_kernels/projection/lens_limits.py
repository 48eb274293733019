"""How far out a lens sees: where its image folds back (lens_models.py)."""

import math

import warp as wp

from warp_kernels.machinery.array_views import empty
from warp_kernels.machinery.lanes import count_bits, lanes_of, warp_ballot
from warp_kernels.machinery.launching import launch_again
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.lens_models import LENS_COEFFS, MAPPED, RATIONAL, LensModel, lens_functions, lens_vector

FOLD_STEPS = 128
"""Angles at which a lens is tried for folding back."""

FOLD_BITS = 50
"""To which the fold is found within its step."""

STEEPEST = 1.5706
"""[rad]: just below π / 2, where x / z ends."""


@made_once
def lens_limit_kernel(dtype: type, model: LensModel) -> wp.Kernel:
    """Where each camera's image folds back, one warp an image; on the CPU a warp is one thread.

    Beyond, the image of a polynomial comes back into the frame, which that of no glass does. The first fold is found by
    going outwards in ``FOLD_STEPS`` steps, a lane each, and then by cutting the step that it is in, a lane each cut.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the coefficients.

    Returns:
        The Warp kernel. It writes the largest r² of a pinhole lens, and the largest angle [rad] of the others.
    """
    coefficients_type = wp.types.vector(LENS_COEFFS, dtype)
    _, _, radial_slope = lens_functions(model)
    zero, unlimited = wp.float64(0.0), 1.0e30
    steps, steepest = wp.float64(FOLD_STEPS), STEEPEST
    stated = model in MAPPED

    @wp.kernel(name=f"lens_limits_{model}_{dtype.__name__}", enable_backward=False, module="unique")
    def lens_limits_kernel(
        lanes: int,
        cuts: int,
        coefficients: wp.array(dtype=coefficients_type),  # [images]
        # outputs
        limits: wp.array(dtype=wp.float64),  # [images]
    ):
        image = wp.tid() // lanes
        lane = wp.tid() % lanes
        k = lens_vector()
        for i in range(wp.static(LENS_COEFFS)):
            k[i] = wp.float64(coefficients[image][i])
        last = wp.float64(steepest)
        if wp.static(stated):
            last = k[15]
        inner, outer = wp.float64(0.0), wp.float64(0.0)
        folds = bool(False)
        step, cut = int(0), int(cuts)
        while step <= wp.static(FOLD_STEPS) and not folds:
            angle = last * wp.float64(wp.min(step + lane, FOLD_STEPS)) / steps
            before = unfolded_lanes(not radial_slope(angle, k) > zero, lanes)  # what is not a number folds too
            if before < lanes:
                folds = True
                inner = last * wp.float64(wp.max(step + before - 1, 0)) / steps
                outer = last * wp.float64(wp.min(step + before, FOLD_STEPS)) / steps
            step += lanes
        while folds and cut > 0:
            width = (outer - inner) / wp.float64(lanes + 1)
            angle = inner + wp.float64(lane + 1) * width
            before = unfolded_lanes(not radial_slope(angle, k) > zero, lanes)
            if before < lanes:
                outer = inner + wp.float64(before + 1) * width
            inner = inner + wp.float64(before) * width
            cut -= 1
        limit = wp.float64(unlimited)
        if wp.static(stated):
            limit = last
        if folds:
            limit = inner
            if wp.static(model in RATIONAL):
                limit = wp.tan(inner) * wp.tan(inner)
        if lane == 0:
            limits[image] = limit

    return lens_limits_kernel


@wp.func
def unfolded_lanes(folded: bool, lanes: int):
    """How many lanes there are before the first one where the image has folded back."""
    taken = warp_ballot(wp.where(folded, 1, 0))
    result = lanes
    if taken != wp.uint32(0):
        result = count_bits(~taken & (taken - wp.uint32(1)))
    return result


def lens_limits(coefficients: wp.array, model: LensModel) -> wp.array:
    """Launches the kernel.

    Args:
        coefficients: vec [images] of ``LENS_COEFFS`` numbers.

    Returns:
        float64 [images].
    """
    device, images = coefficients.device, coefficients.shape[0]
    lanes = lanes_of(device)
    limits = empty(images, wp.float64, device)
    cuts = math.ceil(FOLD_BITS / math.log2(lanes + 1))
    kernel = lens_limit_kernel(coefficients.dtype._wp_scalar_type_, model)
    launch_again(kernel, images * lanes, [lanes, cuts, coefficients, limits], device)
    return limits
