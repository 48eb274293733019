"""Where a pixel's walk ended, for the adjoint: the last pair drawn and the light that is left, in 32 bits.

The caller has an image of alphas, 1 - T rounded. Of a T near 1e-4 that keeps eleven bits in float32, from which the
adjoint cannot begin. What rounding took is at most 2^-25 (2^-54 in float64), and 1 - alpha is exact. So the lower bits
hold the last pair + 1, as many as the number of pairs has. Those above hold what rounding took, in steps that divide
that much evenly, plus their number. Up to half a million pairs leave 13 bits, and lose nothing of a T of 1e-4 in
float32; twice as many lose a bit.
"""

import warp as wp

from warp_kernels.machinery.loading import made_once

FEWEST_BITS, MOST_BITS = 8, 30
"""Of the last pair: steps are whole numbers of float32, and there are two at least each way."""

TAKEN = {wp.float32: 2.0**-25, wp.float64: 2.0**-54}
"""The most that rounding takes from an alpha between a half and one. Below a half it takes nothing: 1 - T is exact."""


def pair_bits(num_pairs: int) -> int:
    """Bits of the last pair.

    Args:
        num_pairs: of the frame, or those there is room for.
    """
    return min(max(num_pairs.bit_length(), FEWEST_BITS), MOST_BITS)


@made_once
def end_functions(dtype: type):
    """Both ways.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``, of the light.

    Returns:
        ``(pack_end, unpack_end)``, Warp functions of the last pair (-1: none), the light, the alpha and the bits; and
        of the number, the alpha and the bits.
    """
    one, most, inverse = dtype(1.0), dtype(TAKEN[dtype]), dtype(1.0 / TAKEN[dtype])

    @wp.func
    def pack_end(last: int, light: dtype, alpha: dtype, bits: int):
        half = 1 << (31 - bits)
        taken = (light - (one - alpha)) * inverse
        steps = wp.clamp(int(wp.rint(taken * dtype(half))), 1 - half, half - 1)
        return int(wp.uint32(last + 1) | (wp.uint32(steps + half) << wp.uint32(bits)))

    @wp.func
    def unpack_end(end: int, alpha: dtype, bits: int):
        """The last pair and the light."""
        half = 1 << (31 - bits)
        last = int(wp.uint32(end) & wp.uint32((1 << bits) - 1)) - 1
        steps = int(wp.uint32(end) >> wp.uint32(bits)) - half
        return last, (one - alpha) + dtype(steps) * (most / dtype(half))

    return pack_end, unpack_end
