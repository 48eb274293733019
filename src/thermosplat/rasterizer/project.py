"""Gaussians projected to cameras with the renderer's defaults, for code that reads the projection or blends itself."""

from collections.abc import Mapping

from torch import Tensor

from thermosplat.rasterizer.arguments import RasterizeMode, as_whole, check_colors, check_shape, checked_settings
from thermosplat.rasterizer.projected_scene import Drawn, ProjectedScene
from warp_kernels.projection.projection import CameraModel


def project(
    means: Tensor,  # [..., N, 3]
    quats: Tensor | None,  # [..., N, 4]
    scales: Tensor | None,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    *,
    drawn: Mapping[str, tuple[Tensor | tuple[Tensor, Tensor], int | None]] | None = None,
    thermal_opacities: Tensor | None = None,  # [..., N]
    covars: Tensor | None = None,  # [..., N, 3, 3]
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    tile_size: int = 16,
    rasterize_mode: RasterizeMode = "classic",
    camera_model: CameraModel = "pinhole",
    deterministic: bool = False,
) -> ProjectedScene:
    """Projects Gaussians, and evaluates their colours, as ``rasterization`` does before it blends.

    Args:
        means: As in ``rasterization``.
        quats: As in ``rasterization``.
        scales: As in ``rasterization``.
        opacities: As in ``rasterization``.
        viewmats: As in ``rasterization``.
        Ks: As in ``rasterization``.
        width: As in ``rasterization``.
        height: As in ``rasterization``.
        drawn: What may be blended, by name: values [..., (C,) N, X] and None, or coefficients of spherical harmonics
            (as ``rasterization``'s colors) and their active degree. ``features`` of the scene are their final values,
            in this order, each [images · N, X].
        thermal_opacities: Second opacities, [..., N]; None: there is one opacity.
        covars: As in ``rasterization``.
        near_plane: As in ``rasterization``.
        far_plane: As in ``rasterization``.
        radius_clip: As in ``rasterization``.
        eps2d: As in ``rasterization``.
        tile_size: As in ``rasterization``.
        rasterize_mode: As in ``rasterization``.
        camera_model: As in ``rasterization``.
        deterministic: As in ``rasterization``.

    Returns:
        The scene: what was projected (``projected``), ``features``, and ``blend``.

    Raises:
        UserError: if an argument has the wrong shape, type or device.
    """
    tile_size = as_whole(tile_size)
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
        sh_degree=None,
        tile_size=tile_size,
        render_mode="RGB",
        rasterize_mode=rasterize_mode,
        camera_model=camera_model,
    )
    if thermal_opacities is not None:
        check_shape("thermal_opacities", thermal_opacities, tuple(opacities.shape), means)
    checked = [
        Drawn(values, sh_degree, check_colors(name, values, means, settings.num_cameras, sh_degree))
        for name, (values, sh_degree) in (drawn or {}).items()
    ]
    gaussians = (means, quats, scales, covars, opacities, thermal_opacities)
    return ProjectedScene(*gaussians, viewmats, Ks, settings, tile_size, drawn=checked, deterministic=deterministic)
