"""Unit quaternions (w, x, y, z) and the rotation matrices they stand for."""

import functools

import warp as wp


@functools.cache
def rotation_functions(dtype: type):
    """Quaternion functions for one scalar type.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        ``(normalize, inverse_norm, to_matrix, matrix_adjoint)``, Warp functions.
    """
    vec4 = wp.types.vector(4, dtype)
    mat33 = wp.types.matrix((3, 3), dtype)
    zero, one, two, tiny = dtype(0.0), dtype(1.0), dtype(2.0), dtype(1.0e-30)

    @wp.func
    def inverse_norm(q: vec4):
        """1 / |q|, and 0 for a quaternion too small to have a direction."""
        # Scaling by the largest component first keeps tiny quaternions from underflowing when squared.
        largest = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
        result = zero
        if largest > tiny:
            result = one / (largest * wp.length(q / largest))
        return result

    @wp.func
    def normalize(q: vec4):
        """Unit quaternion; the zero quaternion stays zero, whose matrix is the identity."""
        largest = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
        result = vec4()
        if largest > tiny:
            scaled = q / largest
            result = scaled / wp.length(scaled)
        return result

    @wp.func
    def to_matrix(q: vec4):
        """Rotation matrix of a unit quaternion."""
        w, x, y, z = q[0], q[1], q[2], q[3]
        return mat33(
            one - two * (y * y + z * z),
            two * (x * y - w * z),
            two * (x * z + w * y),
            two * (x * y + w * z),
            one - two * (x * x + z * z),
            two * (y * z - w * x),
            two * (x * z - w * y),
            two * (y * z + w * x),
            one - two * (x * x + y * y),
        )

    @wp.func
    def matrix_adjoint(q: vec4, v: mat33):
        """Gradient to the quaternion before its normalisation to q, times its length, for the matrix gradient v."""
        w, x, y, z = q[0], q[1], q[2], q[3]
        g = vec4(
            two * (x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1])),
            two
            * (
                -two * x * (v[1, 1] + v[2, 2])
                + y * (v[0, 1] + v[1, 0])
                + z * (v[0, 2] + v[2, 0])
                + w * (v[2, 1] - v[1, 2])
            ),
            two
            * (
                x * (v[0, 1] + v[1, 0])
                - two * y * (v[0, 0] + v[2, 2])
                + z * (v[1, 2] + v[2, 1])
                + w * (v[0, 2] - v[2, 0])
            ),
            two
            * (
                x * (v[0, 2] + v[2, 0])
                + y * (v[1, 2] + v[2, 1])
                - two * z * (v[0, 0] + v[1, 1])
                + w * (v[1, 0] - v[0, 1])
            ),
        )
        return g - wp.dot(g, q) * q

    return normalize, inverse_norm, to_matrix, matrix_adjoint
