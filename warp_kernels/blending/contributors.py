"""Which Gaussians a pixel shows, and with which weights α T: those of the blending, front to back. No gradient."""

import warp as wp

from warp_kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from warp_kernels.machinery.loading import made_once


@made_once
def contributors_kernel(dtype: type) -> wp.Kernel:
    """The kernel, one thread per pixel that is asked for.

    Args:
        dtype: ``wp.float32`` or ``wp.float64``.

    Returns:
        The Warp kernel. Of a pixel with more contributors than there is room for it keeps those of the largest weights,
        in the order of blending; of equal weights the front one.
    """
    vec2, vec3 = wp.types.vector(2, dtype), wp.types.vector(3, dtype)
    zero, half, one = dtype(0.0), dtype(0.5), dtype(1.0)
    alpha_min, alpha_max, least = dtype(ALPHA_MIN), dtype(ALPHA_MAX), dtype(TRANSMITTANCE_MIN)

    @wp.kernel(name=f"contributors_{dtype.__name__}", enable_backward=False, module="unique")
    def contributors(
        first: int,
        tiles_x: int,
        tiles_y: int,
        tile_size: int,
        width: int,
        height: int,
        pixels: wp.array(dtype=wp.int64),  # [pixels], image · height · width + y · width + x
        means2d: wp.array(dtype=vec2),  # [images · N]
        conics: wp.array(dtype=vec3),  # [images · N]
        opacities: wp.array(dtype=dtype),  # [images · N]
        gaussian_ids: wp.array(dtype=wp.int32),  # [pairs]
        tile_offsets: wp.array(dtype=wp.int32),  # [tiles + 1]
        # outputs
        counts: wp.array(dtype=wp.int32),  # [pixels]
        alphas: wp.array(dtype=dtype),  # [pixels]
        ids: wp.array2d(dtype=wp.int32),  # [pixels, room], -1 where there are fewer
        weights: wp.array2d(dtype=dtype),  # [pixels, room], 0 where there are fewer
    ):
        index = wp.tid() + first
        place = pixels[index]
        in_image = int(place % wp.int64(width * height))
        image = int(place // wp.int64(width * height))
        x = in_image % width
        y = in_image // width
        tile = (image * tiles_y + y // tile_size) * tiles_x + x // tile_size
        room = ids.shape[1]
        for k in range(room):
            ids[index, k] = -1
            weights[index, k] = zero
        T = dtype(1.0)
        count = int(0)
        for pair in range(tile_offsets[tile], tile_offsets[tile + 1]):
            gaussian = gaussian_ids[pair]
            dx = means2d[gaussian][0] - (dtype(x) + half)
            dy = means2d[gaussian][1] - (dtype(y) + half)
            Q = conics[gaussian]
            sigma = half * (Q[0] * dx * dx + Q[2] * dy * dy) + Q[1] * dx * dy
            alpha = wp.min(alpha_max, opacities[gaussian] * wp.exp(-sigma))
            if sigma >= zero and alpha >= alpha_min:
                behind = T * (one - alpha)
                if behind <= least:
                    break
                w = alpha * T
                slot = int(-1)
                if count < room:
                    slot = count
                elif room > 0:
                    weakest = int(0)
                    for k in range(1, room):
                        if weights[index, k] <= weights[index, weakest]:
                            weakest = k
                    if w > weights[index, weakest]:
                        for k in range(weakest, room - 1):
                            ids[index, k] = ids[index, k + 1]
                            weights[index, k] = weights[index, k + 1]
                        slot = room - 1
                if slot >= 0:
                    ids[index, slot] = gaussian
                    weights[index, slot] = w
                count += 1
                T = behind
        counts[index] = count
        alphas[index] = one - T

    return contributors
