"""Quaternions (w, x, y, z) of any length and the rotations they stand for."""

import warp as wp

from warp_kernels.machinery.loading import made_once


@made_once
def rotation_functions(dtype: type):
    """Quaternion functions for one scalar type.

    Returns:
        ``(to_matrix, turn_adjoint)``, Warp functions.
    """
    vec3, vec4 = wp.types.vector(3, dtype), wp.types.vector(4, dtype)
    zero, one, two, tiny = dtype(0.0), dtype(1.0), dtype(2.0), dtype(1.0e-30)
    one64, two64 = wp.float64(1.0), wp.float64(2.0)

    @wp.func
    def inverse_size(q: vec4):
        """1 / the largest component, so that squares are in range; 0 for a quaternion too small to have a direction."""
        largest = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
        result = zero
        if largest > tiny:
            result = one / largest
        return result

    @wp.func
    def to_matrix(q: vec4):
        """Rotation matrix in float64; that of a quaternion without a direction is the identity."""
        size = wp.float64(inverse_size(q))
        w, x, y, z = size * wp.float64(q[0]), size * wp.float64(q[1]), size * wp.float64(q[2]), size * wp.float64(q[3])
        # Not by way of the unit quaternion: rounded to float32 it has not quite that length, and its matrix stretches.
        share = wp.float64(0.0)
        if size > share:
            share = two64 / (w * w + x * x + y * y + z * z)
        return wp.mat33d(
            one64 - share * (y * y + z * z),
            share * (x * y - w * z),
            share * (x * z + w * y),
            share * (x * y + w * z),
            one64 - share * (x * x + z * z),
            share * (y * z - w * x),
            share * (x * z - w * y),
            share * (y * z + w * x),
            one64 - share * (x * x + y * y),
        )

    @wp.func
    def turn_adjoint(q: vec4, v: vec3):
        """Gradient to a quaternion for the gradient v to a small turn about the axes of its own rotation.

        A turn δ takes R to R (I + [δ]x), and the unit quaternion q to q + ½ q (0, δ). This has no part along q, which
        would have to be taken away.
        """
        size = inverse_size(q)
        result = vec4()
        if size > zero:
            inverse_norm = one / wp.length(size * q)
            unit = inverse_norm * (size * q)
            w, x, y, z = unit[0], unit[1], unit[2], unit[3]
            result = (two * size * inverse_norm) * vec4(
                -(x * v[0] + y * v[1] + z * v[2]),
                w * v[0] + y * v[2] - z * v[1],
                w * v[1] + z * v[0] - x * v[2],
                w * v[2] + x * v[1] - y * v[0],
            )
        return result

    return to_matrix, turn_adjoint
