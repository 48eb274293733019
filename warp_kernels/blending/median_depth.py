"""The depth before which half of what a pixel shows lies: a median by the weights of the blending. No gradient."""

import math

import warp as wp

from warp_kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from warp_kernels.machinery.loading import made_once
from warp_kernels.projection.packed_roots import packed_root_functions


@made_once
def median_depth_kernel(dtype: type) -> wp.Kernel:
    """The kernel, one thread per pixel.

    Returns:
        The Warp kernel. It walks the list of a pixel's tile twice: to its end, for the transmittance that is left, and
        to the Gaussian behind which half of the accumulated opacity lies.
    """
    vec2, vec4 = wp.types.vector(2, dtype), wp.types.vector(4, dtype)
    zero, half, one = dtype(0.0), dtype(0.5), dtype(1.0)
    alpha_min, alpha_max, least = dtype(ALPHA_MIN), dtype(ALPHA_MAX), dtype(TRANSMITTANCE_MIN)
    farthest = dtype(1.001 * math.log(1.0 / ALPHA_MIN))  # where an opacity of 1 is no longer drawn
    _, unpack, _ = packed_root_functions(dtype)

    @wp.kernel(name=f"median_depth_{dtype.__name__}", enable_backward=False, module="unique")
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
    ):
        index = wp.tid() + first
        in_image = index % (width * height)
        image = index // (width * height)
        x = in_image % width
        y = in_image // width
        tile = (image * tiles_y + y // tile_size) * tiles_x + x // tile_size
        pixel = vec2(dtype(x) + half, dtype(y) + half)
        median = dtype(0.0)
        enough = dtype(0.0)  # transmittance at which a walk ends
        for _walk in range(2):
            T = dtype(1.0)
            for pair in range(tile_offsets[tile], tile_offsets[tile + 1]):
                gaussian = gaussian_ids[pair]
                root = packed_roots[gaussian]
                offset = (means2d[gaussian] - pixel) + unpack(root[3])
                zx = root[0] * (offset[0] + root[1] * offset[1])
                zy = root[2] * offset[1]
                sigma = half * (zx * zx + zy * zy)
                alpha = zero
                if sigma < farthest:
                    alpha = wp.min(alpha_max, opacities[gaussian] * wp.exp(-sigma))
                if alpha >= alpha_min:
                    behind = T * (one - alpha)
                    if behind <= least:
                        break
                    T = behind
                    median = depths[gaussian]
                    if enough >= T:
                        break
            enough = half * (one + T)
        medians[index] = median

    return median_depth
