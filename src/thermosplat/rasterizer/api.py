"""Differentiable rasterization of 3D Gaussians: gsplat's ``rasterization`` and its RGB + thermal sibling.

Conventions are gsplat 1.5.3's: quaternions (w, x, y, z) of any length, world-to-camera view matrices with OpenCV axes,
pixel centres at half-integers. Leading dimensions ``...`` of the Gaussians are scenes; each scene has C cameras.
"""

from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import (
    CameraModel,
    RasterizeMode,
    RenderMode,
    as_whole,
    check_backgrounds,
    check_choice,
    check_colors,
    check_shape,
    checked_settings,
    refuse_unsupported,
)
from thermosplat.rasterizer.graph_breaks import not_compiled
from thermosplat.rasterizer.projected_scene import Drawn, ProjectedScene
from warp_kernels.constants import CHANNELS_MAX

__all__ = ["RGBTRender", "rasterization", "rasterization_rgbt"]


class RGBTRender(NamedTuple):
    """What ``rasterization_rgbt`` returns."""

    render_colors: Tensor
    """Colours at the visible opacity, [..., C, H, W, D]."""
    render_features: Tensor
    """Features at the visible opacity, [..., C, H, W, d]."""
    render_thermal_features: Tensor | None
    """The same features at the thermal opacity, [..., C, H, W, d]; None without thermal opacities."""
    render_alphas: Tensor
    """Accumulated visible opacity, [..., C, H, W, 1]."""
    render_thermal_alphas: Tensor | None
    """Accumulated thermal opacity, [..., C, H, W, 1]; None without thermal opacities."""
    info: dict[str, Any]
    """As ``rasterization``'s, with ``thermal_opacities`` beside ``opacities``."""


@not_compiled
def rasterization(  # noqa: D417 (one sentence has the eleven arguments that are not supported)
    means: Tensor,  # [..., N, 3]
    quats: Tensor | None,  # [..., N, 4]
    scales: Tensor | None,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    colors: Tensor | tuple[Tensor, Tensor],  # [..., (C,) N, D] or [..., (C,) N, K, 3]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [..., C, D]
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: CameraModel = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,  # [..., N, 3, 3]
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any | None = None,
    rolling_shutter: Any | None = None,
    viewmats_rs: Tensor | None = None,
    *,
    deterministic: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders Gaussians with any number of channels; gsplat 1.5.3's ``rasterization`` in signature and meaning.

    Differentiable, once, in means, quats, scales, opacities, colors, covars, viewmats, backgrounds and (unlike gsplat)
    Ks: for second derivatives torch raises, or, of a loss linear in the image, takes gradients for constants. On the
    CPU and on CUDA, in float32 or float64; all tensors have the dtype and device of ``means``. A Gaussian with anything
    non-finite is invisible and counted in ``info["num_nonfinite"]``; before a non-finite camera all of them are.

    Not supported, and only there for gsplat's signature: sparse_grad, distributed, segmented, with_ut, with_eval3d,
    radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs, rolling_shutter, viewmats_rs. Undistort images
    first.

    Args:
        means: Centres, [..., N, 3], world units.
        quats: Rotations (w, x, y, z) of any length, [..., N, 4]. Ignored (may be None) when ``covars`` is given.
        scales: Standard deviations along the Gaussian's axes, [..., N, 3], world units. Ignored with ``covars``.
        opacities: In [0, 1], [..., N].
        colors: Features [..., N, D] or per camera [..., C, N, D]; with ``sh_degree``, coefficients [..., N, K, 3] or
            [..., C, N, K, 3] with K at least (sh_degree + 1)². Stored apart, as 3DGS does, they need not be joined:
            a pair of the first coefficient [..., (C,) N, 1, 3] and the others [..., (C,) N, K - 1, 3].
        viewmats: World-to-camera, OpenCV axes, [..., C, 4, 4].
        Ks: Intrinsics, [..., C, 3, 3], px.
        width: Image width [px], at most 2²⁴.
        height: Image height [px], at most 2²⁴.
        near_plane: Gaussians nearer than this are not drawn [world units].
        far_plane: Gaussians farther than this are not drawn [world units].
        radius_clip: Gaussians whose radii are both at most this are not drawn [px].
        eps2d: Added to the diagonal of the 2D covariance [px²].
        sh_degree: Active degree, 0 to 3; None: ``colors`` are final values.
        packed: Accepted for gsplat's sake; the result and its layout are those of ``packed=False``.
        tile_size: 8, 16 or 32 [px]; changes speed only.
        backgrounds: Colours behind everything, [..., C, D]; finite, which is checked on the CPU alone, as a CUDA device
            would have to be waited for.
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), "RGB+D" or "RGB+ED".
        absgrad: Sums of a traversal's absolute per-pixel gradients add up in ``info["means2d"].absgrad`` like .grad.
        rasterize_mode: "classic", or "antialiased": opacities are scaled by what ``eps2d`` adds to the area
            (Mip-Splatting).
        channel_chunk: At most so many channels are blended in one traversal (never more than 32).
        camera_model: "pinhole" or "ortho".
        covars: Symmetric covariances, [..., N, 3, 3], world units²; only the upper triangle is read.
        deterministic: Gradients are the same to the bit on every run, also on CUDA, where that takes more memory (a
            record of D + 6 numbers for each pair of a Gaussian and a part of a tile) and time. On the CPU always so.

    Returns:
        ``(render_colors, render_alphas, info)``: images [..., C, H, W, X] with X = D, 1 or D + 1; accumulated
        opacities [..., C, H, W, 1]; gsplat's dictionary, parts of which are computed when they are read. Its keys:
        means2d [..., C, N, 2] px, radii int32 [..., C, N, 2] px (0: not drawn), depths [..., C, N], conics
        [..., C, N, 3] 1/px², opacities [..., C, N] as drawn, tiles_per_gauss int32 [..., C, N]; of the sorted
        (Gaussian, tile) pairs flatten_ids int32 [pairs], isect_ids int64 [pairs], and isect_offsets int32
        [..., C, tile_height, tile_width], the first pair of each tile; the numbers width, height, tile_size,
        tile_width, tile_height, n_batches, n_cameras and num_nonfinite; None: batch_ids, camera_ids, gaussian_ids.

    Raises:
        UserError: if an argument has the wrong shape, type or device, or asks for what is not supported.

    Example:
        >>> import torch
        >>> from thermosplat import rasterization
        >>> n = 100
        >>> colors, alphas, info = rasterization(
        ...     means=torch.randn(n, 3), quats=torch.randn(n, 4), scales=0.1 * torch.rand(n, 3),
        ...     opacities=torch.rand(n), colors=torch.rand(n, 3),
        ...     viewmats=torch.eye(4)[None], Ks=torch.tensor([[[300.0, 0, 150], [0, 300, 100], [0, 0, 1]]]),
        ...     width=300, height=200)
        >>> colors.shape, alphas.shape
        (torch.Size([1, 200, 300, 3]), torch.Size([1, 200, 300, 1]))
    """
    refuse_unsupported(
        sparse_grad=sparse_grad,
        distributed=distributed,
        segmented=segmented,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs,
        tangential_coeffs=tangential_coeffs,
        thin_prism_coeffs=thin_prism_coeffs,
        ftheta_coeffs=ftheta_coeffs,
        rolling_shutter=rolling_shutter,
        viewmats_rs=viewmats_rs,
    )
    tile_size, sh_degree, channel_chunk = as_whole(tile_size), as_whole(sh_degree), as_whole(channel_chunk)
    settings = checked_settings(
        means,
        quats,
        scales,
        covars,
        opacities,
        viewmats,
        Ks,
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        sh_degree=sh_degree,
        tile_size=tile_size,
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
        camera_model=camera_model,
    )
    if type(channel_chunk) is not int or channel_chunk < 1:
        raise UserError(f"channel_chunk must be at least 1, and whole, got {channel_chunk!r}.")
    per_camera = check_colors("colors", colors, means, settings.num_cameras, sh_degree)
    check_backgrounds(backgrounds, colors, sh_degree, means, settings.num_cameras)
    drawn = [Drawn(colors, sh_degree, per_camera)] if "RGB" in render_mode else []
    gaussians = (means, quats, scales, covars, opacities, None)
    scene = ProjectedScene(*gaussians, viewmats, Ks, settings, tile_size, drawn=drawn, deterministic=deterministic)
    columns = [*scene.features]
    if "D" in render_mode:
        columns.append(scene.depths.reshape(-1, 1))
        if "ED" in render_mode:
            # The weights' sum, to divide by: 1 - T loses its digits where little is drawn.
            columns.append(torch.ones_like(columns[-1]))
        if backgrounds is not None:
            # Depth has no background, as in gsplat.
            zero = backgrounds.new_zeros(*backgrounds.shape[:-1], 2 if "ED" in render_mode else 1)
            backgrounds = torch.cat([backgrounds, zero], -1) if "RGB" in render_mode else zero
    features = columns[0] if len(columns) == 1 else torch.cat(columns, -1)

    blended = scene.blend_in_chunks(features, min(channel_chunk, CHANNELS_MAX), absgrad)
    render_colors = blended.render
    if backgrounds is not None:
        render_colors = torch.addcmul(render_colors, blended.transmittance, backgrounds[..., None, None, :])
    if "ED" in render_mode:
        expected = render_colors[..., -2:-1] / render_colors[..., -1:].clamp(min=1e-10)
        render_colors = torch.cat([render_colors[..., :-2], expected], -1)
    return render_colors, blended.alphas, scene.info()


@not_compiled
def rasterization_rgbt(
    means: Tensor,  # [..., N, 3]
    quats: Tensor,  # [..., N, 4]
    scales: Tensor,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    thermal_opacities: Tensor | None,  # [..., N]
    colors: Tensor | tuple[Tensor, Tensor],  # [..., (C,) N, D] or [..., (C,) N, K, 3]
    features: Tensor | tuple[Tensor, Tensor],  # [..., (C,) N, d] or [..., (C,) N, K, 3]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    features_sh_degree: int | None = None,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [..., C, D]
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    camera_model: CameraModel = "pinhole",
    deterministic: bool = False,
) -> RGBTRender:
    """Renders colours and features at one opacity and the same features at another, in one traversal.

    ThermoSplat's two rasterization passes (docs/method.md, equations 1 and 2): equal to ``rasterization`` of colours
    and features at ``opacities`` and of features at ``thermal_opacities``, with one projection and one sorted list.

    Args:
        means: Centres, [..., N, 3], world units.
        quats: Rotations (w, x, y, z) of any length, [..., N, 4]; required, as there are no ``covars`` here.
        scales: Standard deviations, [..., N, 3], world units; required likewise.
        opacities: Visible opacities α in [0, 1], [..., N].
        thermal_opacities: Thermal opacities α_t in [0, 1], [..., N]. None: only the visible pass is rendered.
        colors: As in ``rasterization``; with ``sh_degree``, SH coefficients.
        features: Latent features, [..., N, d] or [..., C, N, d]; with ``features_sh_degree``, SH coefficients as
            ``colors``: a second spectrum's colours, d = 3.
        viewmats: World-to-camera, OpenCV axes, [..., C, 4, 4].
        Ks: Intrinsics, [..., C, 3, 3], px.
        width: Image width [px].
        height: Image height [px].
        near_plane: As in ``rasterization``.
        far_plane: As in ``rasterization``.
        radius_clip: As in ``rasterization``.
        eps2d: As in ``rasterization``.
        sh_degree: As in ``rasterization``.
        features_sh_degree: As ``sh_degree``, for ``features``.
        tile_size: As in ``rasterization``.
        backgrounds: Colours behind ``colors`` only, [..., C, D] (D = 3 with ``sh_degree``).
        absgrad: As in ``rasterization``; both passes are one traversal where D + 2 d channels are at most 32.
        rasterize_mode: As in ``rasterization``.
        camera_model: As in ``rasterization``.
        deterministic: As in ``rasterization``.

    Returns:
        The five images and the info dictionary. The gradient of ``info["means2d"]`` is the sum over both passes.

    Raises:
        UserError: if an argument has the wrong shape, type or device, or asks for what is not supported.

    Example:
        >>> import torch
        >>> from thermosplat import rasterization_rgbt
        >>> n = 100
        >>> frame = rasterization_rgbt(
        ...     torch.randn(n, 3), torch.randn(n, 4), 0.1 * torch.rand(n, 3), torch.rand(n), torch.rand(n),
        ...     colors=torch.rand(n, 3), features=torch.rand(n, 8), viewmats=torch.eye(4)[None],
        ...     Ks=torch.tensor([[[300.0, 0, 150], [0, 300, 100], [0, 0, 1]]]), width=300, height=200)
        >>> frame.render_colors.shape, frame.render_thermal_features.shape
        (torch.Size([1, 200, 300, 3]), torch.Size([1, 200, 300, 8]))
    """
    tile_size, sh_degree, features_sh_degree = as_whole(tile_size), as_whole(sh_degree), as_whole(features_sh_degree)
    check_choice("features_sh_degree", features_sh_degree)
    settings = checked_settings(
        means,
        quats,
        scales,
        None,
        opacities,
        viewmats,
        Ks,
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        sh_degree=sh_degree,
        tile_size=tile_size,
        render_mode="RGB",
        rasterize_mode=rasterize_mode,
        camera_model=camera_model,
    )
    if thermal_opacities is not None:
        check_shape("thermal_opacities", thermal_opacities, tuple(opacities.shape), means)
    colors_per_camera = check_colors("colors", colors, means, settings.num_cameras, sh_degree)
    features_per_camera = check_colors("features", features, means, settings.num_cameras, features_sh_degree)
    check_backgrounds(backgrounds, colors, sh_degree, means, settings.num_cameras)
    drawn = [
        Drawn(colors, sh_degree, colors_per_camera),
        Drawn(features, features_sh_degree, features_per_camera),
    ]
    gaussians = (means, quats, scales, None, opacities, thermal_opacities)
    scene = ProjectedScene(*gaussians, viewmats, Ks, settings, tile_size, drawn=drawn, deterministic=deterministic)
    flat_colors, flat_features = scene.features
    channels, dim = flat_colors.shape[-1], flat_features.shape[-1]
    thermal_channels = 0 if thermal_opacities is None else dim
    if channels + dim + thermal_channels <= CHANNELS_MAX:
        blended = scene.blend(flat_colors, absgrad, rest=flat_features, thermal_channels=thermal_channels)
    else:
        both = torch.cat([flat_colors, flat_features], -1)
        blended = scene.blend_in_chunks(both, CHANNELS_MAX, absgrad)
        render_colors, render_features = blended.render.split([channels, dim], dim=-1)
        blended = blended._replace(render=render_colors, rest=render_features)
        if thermal_opacities is not None:
            thermal = scene.blend_in_chunks(flat_features, CHANNELS_MAX, absgrad, thermal_opacity=True)
            blended = blended._replace(thermal_render=thermal.render, thermal_alphas=thermal.alphas)
    render_colors = blended.render
    if backgrounds is not None:
        render_colors = torch.addcmul(render_colors, blended.transmittance, backgrounds[..., None, None, :])
    render_features = cast("Tensor", blended.rest)  # there are two images
    return RGBTRender(
        render_colors, render_features, blended.thermal_render, blended.alphas, blended.thermal_alphas, scene.info()
    )
