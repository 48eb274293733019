"""The depth before which half of what a pixel shows lies: a median by the weights of the blending. No gradient."""

import math

import warp as wp

from warp_kernels.blending.alpha import alpha_functions
from warp_kernels.blending.blend_layout import vectorized
from warp_kernels.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from warp_kernels.machinery.lanes import lane_functions
from warp_kernels.machinery.loading import made_once


def median_block(device: wp.Device) -> int:
    """Edge of the block of pixels that a thread walks together: a CPU has so many in a vector; it divides any tile."""
    return 1 if device.is_cuda else 8


@made_once
def median_depth_kernel(dtype: type, edge: int) -> wp.Kernel:
    """The kernel, one thread per block of pixels.

    Args:
        edge: Of the blocks; the tile's is a multiple of it.

    Returns:
        The Warp kernel. It walks the list of a pixel's tile to its end, for the transmittance E that is left, and again
        to the first Gaussian behind which at most (1 + E) / 2 is left: half of the accumulated opacity lies before it.
        Most walks end sooner. E is no larger than the transmittance T anywhere on the way. So the Gaussian behind which
        half of the light is left is the one, whatever follows, as soon as more than (1 + T) / 2 came to it. A pixel
        whose walk has ended carries the sign in its transmittance.
    """
    vec2, vec4 = wp.types.vector(2, dtype), wp.types.vector(4, dtype)
    vecP, vecPi = wp.types.vector(edge * edge, dtype), wp.types.vector(edge * edge, wp.int32)
    zero, half, one, least = dtype(0.0), dtype(0.5), dtype(1.0), dtype(TRANSMITTANCE_MIN)
    farthest = dtype(1.001 * math.log2(1.0 / ALPHA_MIN))  # |z|² where an opacity of 1 is no longer drawn
    last = edge - 1  # edge is a power of two: keeps indices provably non-negative, which vectorising needs
    of_pixel, attenuate = alpha_functions(dtype), lane_functions(dtype)[1]
    from_middle, in_units, whiten = of_pixel.from_middle, of_pixel.in_units, of_pixel.whiten

    @wp.kernel(
        name=f"median_depth_{dtype.__name__}_{edge}",
        enable_backward=False,
        module="unique",
        module_options=vectorized(edge),  # rolled: in loops that Warp unrolls, numbers of the loop become floats
    )
    def median_depth(
        first: int,
        tiles_x: int,
        tiles_y: int,
        tile_size: int,
        width: int,
        height: int,
        means2d: wp.array(dtype=vec2),  # [images · N]
        packed_roots: wp.array(dtype=vec4),  # [images · N]
        opacities: wp.array(dtype=dtype),  # [images · N]
        depths: wp.array(dtype=dtype),  # [images · N]
        gaussian_ids: wp.array(dtype=wp.int32),  # [pairs]
        tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
        # outputs
        medians: wp.array(dtype=dtype),  # [images · height · width]
        covered: wp.array(dtype=wp.int32),  # [images · height · width], 1 where at most half of the light is left
    ):
        index = wp.tid() + first
        blocks_x = (width + edge - 1) // edge
        blocks_y = (height + edge - 1) // edge
        image = index // (blocks_x * blocks_y)
        x = index % blocks_x * edge
        y = index // blocks_x % blocks_y * edge
        tile = (image * tiles_y + y // tile_size) * tiles_x + x // tile_size
        middle = vec2(dtype(x) + half, dtype(y) + half)  # of the first pixel
        median = vecP()
        enough = vecP()  # transmittance at which a walk ends
        before = vecP()  # transmittance before the Gaussian behind which half of the light is left, and its depth
        half_depth = vecP()
        is_covered = vecPi()
        T = vecP()
        for walk in range(2):
            walking = int(0)  # a bit for each row with a pixel whose walk has not ended
            for row in range(edge):
                for column in range(edge):
                    p = (row & last) * edge + column
                    if walk > 0:
                        enough[p] = half * (one + wp.abs(T[p]))
                    is_told = before[p] > enough[p] and walk > 0  # by the first walk
                    T[p] = wp.where(is_told or x + column >= width or y + row >= height, -one, one)
                    walking = walking | wp.where(T[p] > zero, 1 << row, 0)
            for pair in range(tile_offsets[tile], tile_offsets[tile + 1]):
                if walking == 0:
                    break
                gaussian = gaussian_ids[pair]
                m = from_middle(means2d[gaussian], packed_roots[gaussian], middle)
                root = in_units(packed_roots[gaussian])
                opacity = opacities[gaussian]
                depth = depths[gaussian]
                for row in range(edge):
                    z = root[2] * (m[1] - dtype(row))
                    if z * z < farthest and walking & (1 << row) != 0:
                        left = int(0)
                        for column in range(edge):
                            p = (row & last) * edge + column
                            zx, zy = whiten(root, m[0] - dtype(column), m[1] - dtype(row))
                            alpha = of_pixel.alpha(opacity, of_pixel.visibility(zx, zy))
                            t = T[p]
                            behind = attenuate(t, alpha)
                            is_last = t > zero and behind <= least
                            is_drawn = alpha > zero and t > zero and behind > least
                            is_half = is_drawn and half < t and behind <= half
                            before[p] = wp.where(is_half, t, before[p])
                            half_depth[p] = wp.where(is_half, depth, half_depth[p])
                            is_covered[p] = wp.where(is_half, 1, is_covered[p])
                            is_found = is_drawn and enough[p] >= behind
                            is_told = is_drawn and before[p] > half * (one + behind)
                            found = wp.where(is_told and not is_found, half_depth[p], depth)
                            median[p] = wp.where(is_drawn, found, median[p])
                            t = wp.where(is_drawn, behind, t)
                            T[p] = wp.where(is_last or is_found or is_told, -t, t)
                            left = left | wp.where(T[p] > zero, 1, 0)
                        if left == 0:
                            walking = walking & ~(1 << row)
        for row in range(edge):
            for column in range(edge):
                if x + column < width and y + row < height:
                    pixel = (image * height + y + row) * width + x + column
                    medians[pixel] = median[row * edge + column]
                    covered[pixel] = is_covered[row * edge + column]

    return median_depth
