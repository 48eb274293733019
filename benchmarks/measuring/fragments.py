"""Counts the fragments of a frame, the (pixel, Gaussian) pairs that are drawn: the work no exact renderer can avoid.

A pass of its own, one thread per pixel, that walks the pixel's tile by the plain rules and shares no code with the
blending kernels. It takes gsplat's ``info`` dictionary, so that it counts what the public function said it drew.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from thermosplat.torch_bridge.streams import on_torch_stream
from warp_kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from warp_kernels.machinery.launching import launch


class Fragments(NamedTuple):
    """Pairs of a pixel and a Gaussian, over the whole image.

    Attributes:
        listed: Gaussian in the list of the pixel's tile: what a renderer without culling evaluates.
        drawn: alpha reaches 1/255 in front of where the pixel is opaque.
        thermal: as ``drawn``, at the second opacity; 0 with one opacity.
        either: drawn at one opacity or at both.
        visible: Gaussians (not pairs) in any tile's list.
        longest: longest list of a tile.
    """

    listed: int
    drawn: int
    thermal: int
    either: int
    visible: int
    longest: int


@wp.kernel(enable_backward=False)
def count_kernel(
    first_pixel: int,
    width: int,
    tiles_x: int,
    tile_size: int,
    dual: bool,
    means2d: wp.array(dtype=wp.vec2f),
    conics: wp.array(dtype=wp.vec3f),
    opacities: wp.array(dtype=wp.float32),
    thermal_opacities: wp.array(dtype=wp.float32),
    gaussian_ids: wp.array(dtype=wp.int32),
    tile_offsets: wp.array(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
):
    """Drawn at the first opacity, at the second, at either: [pixels, 3]."""
    pixel = first_pixel + wp.tid()
    x = pixel % width
    y = pixel // width
    tile = (y // tile_size) * tiles_x + x // tile_size
    transmittance = wp.float32(1.0)
    transmittance_t = wp.float32(1.0)
    open_v = wp.int32(1)
    open_t = wp.int32(0)
    if dual:
        open_t = wp.int32(1)
    drawn_v = wp.int32(0)
    drawn_t = wp.int32(0)
    either = wp.int32(0)
    i = wp.int32(tile_offsets[tile])
    end = tile_offsets[tile + 1]
    while i < end and open_v + open_t > 0:
        g = gaussian_ids[i]
        offset = means2d[g] - wp.vec2f(wp.float32(x) + 0.5, wp.float32(y) + 0.5)
        q = conics[g]
        sigma = 0.5 * (q[0] * offset[0] * offset[0] + q[2] * offset[1] * offset[1]) + q[1] * offset[0] * offset[1]
        visibility = wp.exp(-wp.max(sigma, 0.0))
        hit = wp.int32(0)
        if open_v == 1:
            alpha = wp.min(wp.float32(ALPHA_MAX), opacities[g] * visibility)
            if alpha >= wp.float32(ALPHA_MIN):
                behind = transmittance * (1.0 - alpha)
                if behind <= wp.float32(TRANSMITTANCE_MIN):
                    open_v = 0
                else:
                    transmittance = behind
                    drawn_v += 1
                    hit = 1
        if open_t == 1:
            alpha_t = wp.min(wp.float32(ALPHA_MAX), thermal_opacities[g] * visibility)
            if alpha_t >= wp.float32(ALPHA_MIN):
                behind_t = transmittance_t * (1.0 - alpha_t)
                if behind_t <= wp.float32(TRANSMITTANCE_MIN):
                    open_t = 0
                else:
                    transmittance_t = behind_t
                    drawn_t += 1
                    hit = 1
        either += hit
        i += 1
    counts[pixel, 0] = drawn_v
    counts[pixel, 1] = drawn_t
    counts[pixel, 2] = either


def count_fragments(info: Mapping[str, Any], width: int, height: int) -> Fragments:
    """Counts the fragments of one rendered image.

    Args:
        info: third result of ``rasterization`` for one camera in float32 (of ``rasterization_rgbt``: with
            ``thermal_opacities``).
        width: image width [px].
        height: image height [px].

    Returns:
        The counts.
    """
    means2d, conics = info["means2d"].detach().reshape(-1, 2), info["conics"].detach().reshape(-1, 3)
    opacities = info["opacities"].detach().reshape(-1).contiguous()
    thermal = info.get("thermal_opacities")
    tile_size, tiles_x = info["tile_size"], info["tile_width"]
    ids = info["flatten_ids"]
    offsets = torch.cat([info["isect_offsets"].reshape(-1), ids.new_full((1,), len(ids))]).int().contiguous()
    device = means2d.device
    counts = torch.zeros(width * height, 3, dtype=torch.int32, device=device)
    seconds = opacities if thermal is None else thermal.detach().reshape(-1).contiguous()
    with on_torch_stream(device) as warp_device:
        arguments = [
            width,
            tiles_x,
            tile_size,
            thermal is not None,
            wp.from_torch(means2d.contiguous(), wp.vec2f),
            wp.from_torch(conics.contiguous(), wp.vec3f),
            wp.from_torch(opacities, wp.float32),
            wp.from_torch(seconds, wp.float32),
            wp.from_torch(ids, wp.int32),
            wp.from_torch(offsets, wp.int32),
            wp.from_torch(counts, wp.int32),
        ]
        launch(count_kernel, width * height, arguments, warp_device)
    drawn, drawn_thermal, either = (int(n) for n in counts.sum(0, dtype=torch.int64).tolist())
    lengths = offsets.diff()
    return Fragments(
        int((lengths.long() * _pixels_of_tiles(width, height, tile_size, device)).sum()),
        drawn,
        drawn_thermal,
        either,
        int(torch.unique(ids).numel()),
        int(lengths.max()) if lengths.numel() else 0,
    )


def _pixels_of_tiles(width: int, height: int, tile_size: int, device: torch.device) -> Tensor:
    """Pixels of each tile that lie in the image, row by row of tiles."""

    def lengths(size: int) -> Tensor:
        edges = torch.arange(0, size, tile_size, device=device)
        return (size - edges).clamp(max=tile_size)

    return (lengths(height)[:, None] * lengths(width)).reshape(-1)
