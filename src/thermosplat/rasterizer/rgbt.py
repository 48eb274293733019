"""``rasterization_rgbt``: colours and features of an RGB + thermal frame, each at its opacity, in one traversal."""

from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from thermosplat.rasterizer.arguments import check_backgrounds, checked_choice
from thermosplat.rasterizer.call_inputs import (
    BlendedValues,
    CameraModel,
    Cameras,
    Drawn,
    LensArguments,
    RasterizeMode,
    Splats,
)
from thermosplat.rasterizer.replay.replayed_calls import replayed
from thermosplat.rasterizer.scene_of_call import scene_of
from warp_kernels.constants import CHANNELS_MAX


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


@replayed
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
    with_ut: bool = False,
    radial_coeffs: Tensor | None = None,  # [..., C, 6] or [..., C, 4]
    tangential_coeffs: Tensor | None = None,  # [..., C, 2]
    thin_prism_coeffs: Tensor | None = None,  # [..., C, 4]
    ftheta_coeffs: Any | None = None,
    rolling_shutter: Any | None = None,
    viewmats_rs: Tensor | None = None,  # [..., C, 4, 4]
    deterministic: bool = False,
    distributed: bool = False,
) -> RGBTRender:
    """Renders colours and features at one opacity and the same features at another, in one traversal.

    ThermoSplat's two rasterization passes (docs/method.md, equations 1 and 2): equal to ``rasterization`` of colours
    and features at ``opacities`` and of features at ``thermal_opacities``, with one projection and one sorted list.
    The other arguments are those of ``rasterization``.

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
        features_sh_degree: As ``sh_degree``, for ``features``.
        backgrounds: Colours behind ``colors`` only, [..., C, D] (D = 3 with ``sh_degree``).
        absgrad: As in ``rasterization``; both passes are one traversal where D + 2 d channels are at most 32.

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
    sh_degree = checked_choice("sh_degree", sh_degree)
    features_sh_degree = checked_choice("features_sh_degree", features_sh_degree)
    coefficients = (radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs)
    lens = LensArguments(with_ut, *coefficients, rolling_shutter, viewmats_rs)
    values = {"colors": BlendedValues(colors, sh_degree), "features": BlendedValues(features, features_sh_degree)}
    scene = scene_of(
        Splats(means, quats, scales, opacities, None, thermal_opacities),
        Cameras(viewmats, Ks, width, height, near_plane, far_plane, camera_model, lens),
        Drawn(values, radius_clip, eps2d, tile_size, rasterize_mode, deterministic, distributed=distributed),
    )
    channels = (colors[0] if isinstance(colors, tuple) else colors).shape[-1]
    check_backgrounds(backgrounds, channels, means, scene.settings.num_cameras)
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
