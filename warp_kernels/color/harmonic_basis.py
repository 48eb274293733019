"""The real spherical harmonics of degree 0 to 4 as Warp functions: values, and their gradient.

The basis is 3DGS's (Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2013, with its signs), continued to degree
4 as gsplat does.
"""

import warp as wp

from warp_kernels.machinery.loading import made_once

# Normalisation constants of the real basis functions.
C0 = 0.28209479177387814  # sqrt(1 / 4π)
C1 = 0.4886025119029199  # sqrt(3 / 4π)
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
C4 = (
    2.5033429417967046,
    1.7701307697799304,
    0.9461746957575601,
    0.6690465435572892,
    0.10578554691520431,
    0.47308734787878004,
    0.6258357354491761,
)

FEW, ALL = 16, 25
"""Values of degree 3 and below, and of degree 4: kernels for the former keep no registers for the latter."""


def values_for(degree: int) -> int:
    """Which of ``FEW`` and ``ALL`` a degree needs."""
    return FEW if degree <= 3 else ALL


@made_once
def basis_functions(dtype: type, most: int):
    """Basis values and their gradient with respect to the unit direction.

    Args:
        most: ``FEW`` or ``ALL``.

    Returns:
        ``(basis, basis_adjoint)``: basis(d, degree) -> ``most`` values, zero above the degree;
        basis_adjoint(d, degree, v) -> gradient to d for the gradient v to the values.
    """
    vec3, vecK = wp.types.vector(3, dtype), wp.types.vector(most, dtype)
    one, two, three = (dtype(x) for x in (1.0, 2.0, 3.0))
    c0, c1 = dtype(C0), dtype(C1)
    c20, c21, c22 = (dtype(x) for x in C2)
    c30, c31, c32, c33, c34 = (dtype(x) for x in C3)
    c40, c41, c42, c43, c44, c45, c46 = (dtype(x) for x in C4)

    @wp.func
    def basis(d: vec3, degree: int):
        x, y, z = d[0], d[1], d[2]
        b = vecK()
        b[0] = c0
        if degree > 0:
            b[1] = -c1 * y
            b[2] = c1 * z
            b[3] = -c1 * x
        if degree > 1:
            b[4] = c20 * x * y
            b[5] = -c20 * y * z
            b[6] = c21 * (three * z * z - one)
            b[7] = -c20 * x * z
            b[8] = c22 * (x * x - y * y)
        if degree > 2:
            b[9] = -c30 * y * (three * x * x - y * y)
            b[10] = c31 * x * y * z
            b[11] = -c32 * y * (dtype(5.0) * z * z - one)
            b[12] = c33 * z * (dtype(5.0) * z * z - three)
            b[13] = -c32 * x * (dtype(5.0) * z * z - one)
            b[14] = c34 * z * (x * x - y * y)
            b[15] = -c30 * x * (x * x - three * y * y)
        if wp.static(most == ALL):
            if degree > 3:
                seven_z, squares = dtype(7.0) * z * z, x * x - y * y
                b[16] = c40 * x * y * squares
                b[17] = -c41 * y * z * (three * x * x - y * y)
                b[18] = c42 * x * y * (seven_z - one)
                b[19] = -c43 * y * z * (seven_z - three)
                b[20] = c44 * (dtype(5.0) * z * z * (seven_z - dtype(6.0)) + three)
                b[21] = -c43 * x * z * (seven_z - three)
                b[22] = c45 * squares * (seven_z - one)
                b[23] = -c41 * x * z * (x * x - three * y * y)
                b[24] = c46 * (squares * squares - dtype(4.0) * x * x * y * y)
        return b

    @wp.func
    def basis_adjoint(d: vec3, degree: int, v: vecK):
        x, y, z = d[0], d[1], d[2]
        g = vec3()
        if degree > 0:
            g = vec3(-c1 * v[3], -c1 * v[1], c1 * v[2])
        if degree > 1:
            g = g + vec3(
                c20 * (y * v[4] - z * v[7]) + two * c22 * x * v[8],
                c20 * (x * v[4] - z * v[5]) - two * c22 * y * v[8],
                dtype(6.0) * c21 * z * v[6] - c20 * (y * v[5] + x * v[7]),
            )
        if degree > 2:
            five_z = dtype(5.0) * z * z - one
            squares = x * x - y * y
            g = g + vec3(
                -dtype(6.0) * c30 * x * y * v[9]
                + c31 * y * z * v[10]
                - c32 * five_z * v[13]
                + two * c34 * x * z * v[14]
                - three * c30 * squares * v[15],
                -three * c30 * squares * v[9]
                + c31 * x * z * v[10]
                - c32 * five_z * v[11]
                - two * c34 * y * z * v[14]
                + dtype(6.0) * c30 * x * y * v[15],
                c31 * x * y * v[10]
                - dtype(10.0) * c32 * y * z * v[11]
                + three * c33 * five_z * v[12]
                - dtype(10.0) * c32 * x * z * v[13]
                + c34 * squares * v[14],
            )
        if wp.static(most == ALL):
            if degree > 3:
                seven_z, differences = dtype(7.0) * z * z, three * (x * x - y * y)
                lower, upper = three * x * x - y * y, x * x - three * y * y
                g = g + vec3(
                    c40 * y * lower * v[16]
                    - c41 * z * (dtype(6.0) * x * y * v[17] + differences * v[23])
                    + (seven_z - one) * (c42 * y * v[18] + two * c45 * x * v[22])
                    - c43 * z * (seven_z - three) * v[21]
                    + dtype(4.0) * c46 * x * upper * v[24],
                    c40 * x * upper * v[16]
                    - c41 * z * (differences * v[17] - dtype(6.0) * x * y * v[23])
                    + (seven_z - one) * (c42 * x * v[18] - two * c45 * y * v[22])
                    - c43 * z * (seven_z - three) * v[19]
                    - dtype(4.0) * c46 * y * lower * v[24],
                    -c41 * (y * lower * v[17] + x * upper * v[23])
                    + dtype(14.0) * z * (c42 * x * y * v[18] + c45 * (x * x - y * y) * v[22])
                    - three * c43 * (seven_z - one) * (y * v[19] + x * v[21])
                    + dtype(20.0) * c44 * z * (seven_z - three) * v[20],
                )
        return g

    return basis, basis_adjoint
