"""A plain vectorised torch renderer: what one writes without kernels. One tile after the other, gradients by autograd.

It follows gsplat 1.5.3's rules: alpha from 1/255 to 0.999, and the Gaussian that would bring a pixel's transmittance to
1e-4 is not drawn. Projection and spherical harmonics are those of the tests' dense reference.
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from peers.peer import NEAR_PLANE, Peer, Rendered, Tensors

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "fixtures"))
from reference_projection import ALPHA_MIN, flat_scene, project, view_colors
from reference_rasterizer import ALPHA_MAX, TRANSMITTANCE_MIN

TILE = 16
"""Edge of a tile [px]."""


def torch_peer() -> Peer:
    """The renderer as a peer; it runs on any device."""

    def renderer(case: str, t: Tensors, width: int, height: int) -> Callable[[], Rendered]:
        def render() -> Rendered:
            means, covars, viewmats, Ks = flat_scene(t["means"], t["quats"], t["scales"], None, t["viewmats"], t["Ks"])
            thermal = t.get("thermal_opacities")
            bound = t["opacities"] if thermal is None else torch.maximum(t["opacities"], thermal)
            projected = project(
                means,
                covars,
                viewmats,
                Ks,
                bound.detach()[None, None],
                torch.ones_like(bound, dtype=torch.bool)[None, None],
                width,
                height,
                near_plane=NEAR_PLANE,
                far_plane=1e10,
                radius_clip=0.0,
                eps2d=0.3,
                antialiased=False,
                camera_model="pinhole",
            )
            visible = projected.visible[0, 0].nonzero().squeeze(1)
            order = visible[projected.depths[0, 0, visible].argsort(stable=True)]
            values = [t["features"]] if "features" in t else []
            if "sh" in t:
                values.insert(0, view_colors(t["sh"][None, None], means, viewmats, projected.visible, 3)[0, 0])
            layers = [(t["opacities"][order], torch.cat(values, -1)[order])]
            if thermal is not None:
                layers.append((thermal[order], t["features"][order]))
            geometry = (projected.means2d[0, 0, order], projected.conics[0, 0, order], projected.radii[0, 0, order])
            images = blend_tiles(*geometry, layers, width, height)
            if case == "rgbt":
                images = [*images[0].split([3, t["features"].shape[-1]], -1), *images[1:]]
            return Rendered(images, [])

        return render

    return Peer("plain torch", f"torch {torch.__version__}, tiles in a loop", renderer)


def blend_tiles(
    means2d: Tensor,
    conics: Tensor,
    radii: Tensor,
    layers: list[tuple[Tensor, Tensor]],
    width: int,
    height: int,
) -> list[Tensor]:
    """Blends Gaussians sorted by depth, tile by tile.

    Args:
        means2d: [n, 2] px.
        conics: [n, 3] inverse 2D covariances (xx, xy, yy) [1/px²].
        radii: [n, 2] half the edges of the rectangle a Gaussian can reach [px].
        layers: opacities [n] and values [n, D]; each is blended by itself.
        width: image width [px].
        height: image height [px].

    Returns:
        For each layer the image [1, height, width, D] and alphas [1, height, width, 1].
    """
    low, high = (means2d - radii).detach(), (means2d + radii).detach()
    bands: list[list[Tensor]] = [[] for _ in range(2 * len(layers))]
    for top in range(0, height, TILE):
        bottom = min(top + TILE, height)
        in_band = ((high[:, 1] > top) & (low[:, 1] < bottom)).nonzero().squeeze(1)
        pieces: list[list[Tensor]] = [[] for _ in bands]
        for left in range(0, width, TILE):
            right = min(left + TILE, width)
            near = in_band[(high[in_band, 0] > left) & (low[in_band, 0] < right)]
            y, x = torch.meshgrid(
                torch.arange(top, bottom, device=means2d.device) + 0.5,
                torch.arange(left, right, device=means2d.device) + 0.5,
                indexing="ij",
            )
            # [pixels, n]: what is accumulated along the Gaussians lies side by side in memory.
            dx, dy = means2d[near, 0] - x.reshape(-1, 1), means2d[near, 1] - y.reshape(-1, 1)
            xx, xy, yy = conics[near].unbind(-1)
            visibility = torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
            for k, (opacities, values) in enumerate(layers):
                alphas = (opacities[near] * visibility).clamp(max=ALPHA_MAX)
                alphas = torch.where(alphas < ALPHA_MIN, 0.0, alphas)
                # A sum of logarithms, whose gradient is a sum again; that of cumprod is many times slower.
                with torch.no_grad():
                    drawn = torch.log1p(-alphas).cumsum(1) > math.log(TRANSMITTANCE_MIN)
                alphas = torch.where(drawn, alphas, 0.0)
                logs = torch.log1p(-alphas)
                behind = logs.cumsum(1)
                image = (alphas * torch.exp(behind - logs)) @ values[near]
                passed = torch.exp(logs.sum(1))
                pieces[2 * k].append(image.reshape(*x.shape, -1))
                pieces[2 * k + 1].append(1.0 - passed.reshape(*x.shape, 1))
        for band, parts in zip(bands, pieces, strict=True):
            band.append(torch.cat(parts, 1))
    return [torch.cat(band)[None] for band in bands]
