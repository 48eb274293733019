"""A dense, untiled Gaussian rasterizer in plain torch: the truth the kernels are held against.

Every pixel is compared with every Gaussian, in any floating dtype (float64 is the usual one), and torch's
autograd supplies all gradients. It follows gsplat 1.5.3's meaning of each argument and shares no code with the
kernels: nothing is binned, fused or differentiated by hand.

``info["uncertain"]`` [..., C, H, W] marks the pixels where an implementation in lower precision may legitimately
differ, because something the pixel depends on lies within ``MARGIN`` of a documented threshold: alpha at 1/255 or
0.999, transmittance at 1e-4, the Jacobian's field-of-view clamp, or two depths that round to the same number.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from reference_projection import (
    ALPHA_MIN,
    MARGIN,
    ProjectedGaussians,
    flat_scene,
    per_camera_values,
    project,
    view_colors,
)

ALPHA_MAX = 0.999  # gsplat 1.5.3 (its main branch: 0.99)
TRANSMITTANCE_MIN = 1e-4  # the Gaussian that would reach it is not drawn
PIXELS_PER_CHUNK = 4_000_000  # pixel-Gaussian pairs held at once


class ReferenceRGBT(NamedTuple):
    """What rasterization_rgbt returns."""

    render_colors: Tensor
    render_features: Tensor
    render_thermal_features: Tensor
    render_alphas: Tensor
    render_thermal_alphas: Tensor
    info: dict[str, Any]


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
    covars: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """gsplat's ``rasterization``; ``packed`` and ``tile_size`` do not matter to a dense renderer."""
    del packed, tile_size
    batch, cameras, n = means.shape[:-2], viewmats.shape[-3], means.shape[-2]
    scene = flat_scene(means, quats, scales, covars, viewmats, Ks)
    raw_opacities = opacities.reshape(len(scene[0]), 1, n)
    raw_colors = per_camera_values(
        colors, len(scene[0]), cameras, tail_dims=1 if sh_degree is None else 2, batch_dims=len(batch)
    )
    projected = project(
        *scene,
        raw_opacities,
        _finite(raw_colors, 1 if sh_degree is None else 2),
        width,
        height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        antialiased=rasterize_mode == "antialiased",
        camera_model=camera_model,
    )
    values = _visible_values(raw_colors, scene, projected, sh_degree)
    if "D" in render_mode:
        depths, with_colors = projected.depths[..., None], render_mode.startswith("RGB")
        values = torch.cat([values, depths], -1) if with_colors else depths
        if backgrounds is not None:
            zero = torch.zeros_like(backgrounds[..., :1])
            backgrounds = torch.cat([backgrounds, zero], -1) if with_colors else zero
    effective = torch.where(projected.visible, raw_opacities, 0.0) * projected.compensations
    image, alphas, uncertain = blend(projected, effective, values, width, height, absgrad)
    if backgrounds is not None:
        image = image + (1.0 - alphas) * backgrounds.reshape(-1, cameras, 1, 1, backgrounds.shape[-1])
    if "ED" in render_mode:
        image = torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=1e-10)], -1)
    info = _info(projected, uncertain, effective, batch, width, height)
    lead = (*batch, cameras, height, width)
    return image.reshape(*lead, image.shape[-1]), alphas.reshape(*lead, 1), info


def rasterization_rgbt(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    thermal_opacities: Tensor,
    colors: Tensor,
    features: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    camera_model: str = "pinhole",
) -> ReferenceRGBT:
    """Colours and features at one opacity, the same features at the other, from one projection."""
    del tile_size
    batch, cameras, n = means.shape[:-2], viewmats.shape[-3], means.shape[-2]
    scene = flat_scene(means, quats, scales, None, viewmats, Ks)
    rgb_opacities = opacities.reshape(len(scene[0]), 1, n)
    thermal_opacities = thermal_opacities.reshape(len(scene[0]), 1, n)
    sh_dims = 1 if sh_degree is None else 2
    raw_colors = per_camera_values(colors, len(scene[0]), cameras, tail_dims=sh_dims, batch_dims=len(batch))
    raw_features = per_camera_values(features, len(scene[0]), cameras, tail_dims=1, batch_dims=len(batch))
    projected = project(
        *scene,
        torch.maximum(rgb_opacities, thermal_opacities),
        _finite(raw_colors, sh_dims) & _finite(raw_features, 1),
        width,
        height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        antialiased=rasterize_mode == "antialiased",
        camera_model=camera_model,
    )
    rgb = _visible_values(raw_colors, scene, projected, sh_degree)
    latent = _visible_values(raw_features, scene, projected, None)
    at_rgb = torch.where(projected.visible, rgb_opacities, 0.0) * projected.compensations
    at_thermal = torch.where(projected.visible, thermal_opacities, 0.0) * projected.compensations
    image, alphas, doubt = blend(projected, at_rgb, torch.cat([rgb, latent], -1), width, height, absgrad)
    thermal, thermal_alphas, thermal_doubt = blend(projected, at_thermal, latent, width, height, absgrad)
    render_colors = image[..., :3]
    if backgrounds is not None:
        render_colors = render_colors + (1.0 - alphas) * backgrounds.reshape(-1, cameras, 1, 1, 3)
    info = _info(projected, doubt | thermal_doubt, at_rgb, batch, width, height)
    lead = (*batch, cameras, height, width)
    renders = (render_colors, image[..., 3:], thermal, alphas, thermal_alphas)
    return ReferenceRGBT(*(render.reshape(*lead, render.shape[-1]) for render in renders), info)


def _finite(values: Tensor, tail_dims: int) -> Tensor:
    """[B, C, N]: whether all of a Gaussian's values are finite."""
    return torch.isfinite(values).flatten(-tail_dims).all(-1)


def _visible_values(
    raw: Tensor, scene: tuple[Tensor, ...], projected: ProjectedGaussians, sh_degree: int | None
) -> Tensor:
    if sh_degree is None:
        return torch.where(projected.visible[..., None], raw, 0.0)
    return view_colors(raw, scene[0], scene[2], projected.visible, sh_degree)


def blend(
    projected: ProjectedGaussians, opacities: Tensor, values: Tensor, width: int, height: int, absgrad: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Front to back over all Gaussians: image [B, C, H, W, D], alphas [B, C, H, W, 1], uncertain [B, C, H, W]."""
    batches, cameras, _ = opacities.shape
    rows = torch.arange(height, dtype=values.dtype, device=values.device) + 0.5
    columns = torch.arange(width, dtype=values.dtype, device=values.device) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).reshape(-1, 2)
    sums = None
    if absgrad:  # kept where gsplat keeps it; a second blend of the same projection adds to it
        sums = getattr(projected.means2d, "absgrad", torch.zeros_like(projected.means2d).detach())
        projected.means2d.absgrad = sums  # type: ignore[attr-defined]
    images, alphas, uncertain = [], [], []
    for b in range(batches):
        for c in range(cameras):
            order = torch.argsort(projected.depths[b, c].detach(), stable=True)
            order = order[projected.visible[b, c][order]]
            picked = [t[b, c][order] for t in (projected.means2d, projected.conics, opacities, values)]
            marks = _order_marks(projected.depths[b, c][order].detach()), projected.marginal[b, c][order]
            for chunk in pixels.split(max(1, PIXELS_PER_CHUNK // max(1, len(order)))):
                target = None if sums is None else (sums[b, c], order)
                # One chunk keeps its graph; several are recomputed in the backward pass to bound memory.
                if len(chunk) == len(pixels):
                    image, alpha, doubt = _blend_pixels(chunk, *picked, *marks, target)
                else:
                    args = (chunk, *picked, *marks, target)
                    image, alpha, doubt = checkpoint(_blend_pixels, *args, use_reentrant=False)
                images.append(image)
                alphas.append(alpha)
                uncertain.append(doubt)
    shape = (batches, cameras, height, width)
    return (
        torch.cat(images).reshape(*shape, values.shape[-1]),
        torch.cat(alphas).reshape(*shape, 1),
        torch.cat(uncertain).reshape(shape),
    )


def _order_marks(depths: Tensor) -> Tensor:
    """Whether each sorted depth is so near the next one that lower precision may swap the two."""
    close = torch.zeros_like(depths, dtype=torch.bool)
    gaps = depths[1:] - depths[:-1]
    # An exact tie is not uncertain: both sides resolve it by index.
    close[:-1] = (gaps > 0) & (gaps < 1e-5 * depths[1:].abs())
    return close


def _blend_pixels(
    pixels: Tensor,  # [P, 2]
    means2d: Tensor,  # [n, 2], sorted by depth
    conics: Tensor,  # [n, 3]
    opacities: Tensor,  # [n]
    values: Tensor,  # [n, D]
    swappable: Tensor,  # [n] bool
    marginal: Tensor,  # [n] bool
    absgrad: tuple[Tensor, Tensor] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    offsets = means2d[None] - pixels[:, None]  # [P, n, 2]
    if absgrad is not None and offsets.requires_grad:
        sums, order = absgrad

        def add_absolute_values(grad: Tensor) -> None:
            sums.index_add_(0, order, grad.abs().sum(0))

        offsets.register_hook(add_absolute_values)
    dx, dy = offsets.unbind(-1)
    sigmas = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    unclamped = opacities * torch.exp(-sigmas.clamp(min=0.0))
    alphas = unclamped.clamp(max=ALPHA_MAX)
    with torch.no_grad():
        drawn = (sigmas >= 0) & (alphas >= ALPHA_MIN)
        after = torch.cumprod(torch.where(drawn, 1.0 - alphas, 1.0), 1)  # transmittance behind each Gaussian
        alive = after > TRANSMITTANCE_MIN
        reached = torch.ones_like(alive)
        reached[:, 1:] = alive[:, :-1]
        near = lambda value, threshold: (value / threshold - 1.0).abs() < MARGIN  # noqa: E731
        doubt = reached & (near(unclamped, ALPHA_MIN) | near(unclamped, ALPHA_MAX) | near(after, TRANSMITTANCE_MIN))
        faint = unclamped >= ALPHA_MIN * (1 - MARGIN)
        doubt |= reached & faint & marginal
        doubt[:, :-1] |= (reached & faint & swappable)[:, :-1] & faint[:, 1:]
    alphas = torch.where(drawn & alive, alphas, 0.0)
    transmittances = torch.cumprod(1.0 - alphas, 1)
    before = torch.cat([torch.ones_like(pixels[:, :1]), transmittances], 1)
    image = (alphas * before[:, :-1]) @ values
    return image, 1.0 - before[:, -1:], doubt.any(1)


def _info(
    projected: ProjectedGaussians, uncertain: Tensor, opacities: Tensor, batch: torch.Size, width: int, height: int
) -> dict[str, Any]:
    cameras = projected.visible.shape[1]

    def shaped(tensor: Tensor) -> Tensor:
        # Tensors that already have the public shape keep their identity, so that retain_grad() works on means2d.
        return tensor[0] if len(batch) == 0 else tensor.reshape(*batch, *tensor.shape[1:])

    return {
        "radii": shaped(projected.radii),
        "means2d": projected.means2d,  # [B, C, N, 2] in the graph
        "depths": shaped(projected.depths),
        "conics": shaped(projected.conics),
        "opacities": shaped(opacities),
        "visible": shaped(projected.visible),
        "uncertain": shaped(uncertain),
        "width": width,
        "height": height,
        "n_cameras": cameras,
    }
