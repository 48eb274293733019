"""Gaussians projected to cameras with the renderer's defaults, for code that reads the projection or blends itself."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from thermosplat.distributed.collectives import check_is_joined
from thermosplat.rasterizer.arguments import (
    CameraModel,
    RasterizeMode,
    check_choice,
    check_colors,
    check_shape,
    checked_settings,
)
from thermosplat.rasterizer.cameras_of_ranks import CameraKind, check_cameras
from thermosplat.rasterizer.checked_numbers import as_whole, checked_sizes
from thermosplat.rasterizer.exchanged_scene import scene_among_ranks
from thermosplat.rasterizer.lenses import PLAIN, LensArguments, Lenses, checked_lenses
from thermosplat.rasterizer.projected_scene import BlendedValues, ProjectedScene
from thermosplat.rasterizer.signals import Signal
from warp_kernels.projection.projection import ProjectionSettings

_UPPER = [0, 1, 2, 1, 3, 4, 2, 4, 5]  # places of a full matrix's entries in an upper triangle


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
    drawn: Mapping[str, Signal | tuple[Tensor | tuple[Tensor, Tensor], int | None]] | None = None,
    thermal_opacities: Tensor | None = None,  # [..., N]
    covars: Tensor | None = None,  # [..., N, 3, 3] or [..., N, 6]
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    tile_size: int = 16,
    rasterize_mode: RasterizeMode = "classic",
    camera_model: CameraModel = "pinhole",
    lens: LensArguments = PLAIN,
    deterministic: bool = False,
    global_z_order: bool = True,
    distributed: bool = False,
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
        lens: The other arguments of ``rasterization`` that describe lenses and shutters.
        deterministic: As in ``rasterization``.
        global_z_order: As in ``rasterization``.
        distributed: As in ``rasterization``.

    Returns:
        The scene: what was projected (``projected``), ``features``, and ``blend``.

    Raises:
        UserError: if an argument has the wrong shape, type or device.
    """
    tile_size = as_whole(tile_size)
    if isinstance(covars, Tensor) and covars.shape[-1:] == (6,):
        covars = covars[..., _UPPER].unflatten(-1, (3, 3))

    def settings_of(viewmats: Tensor, Ks: Tensor, width: int, height: int, model: CameraModel) -> ProjectionSettings:
        return checked_settings(
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
            tile_size=tile_size,
            rasterize_mode=rasterize_mode,
            camera_model=model,
        )

    def projected(
        viewmats: Tensor,
        Ks: Tensor,
        settings: ProjectionSettings,
        lenses: Lenses | None,
        cameras: slice = slice(None),
    ) -> ProjectedScene:
        if thermal_opacities is not None:
            check_shape("thermal_opacities", thermal_opacities, opacities.shape, means)
        checked = []
        for name, (of_all, degree, *clamped) in (drawn or {}).items():
            values = _of_cameras(of_all, degree, cameras) if distributed else of_all
            per_camera = check_colors(name, values, means, settings.num_cameras, degree)
            checked.append(BlendedValues(values, degree, per_camera, *clamped))
        return ProjectedScene(
            means,
            quats,
            scales,
            covars,
            opacities,
            thermal_opacities,
            viewmats,
            Ks,
            settings,
            tile_size,
            drawn=checked,
            deterministic=deterministic,
            global_z_order=global_z_order,
            lenses=lenses,
        )

    if not distributed:
        settings = settings_of(viewmats, Ks, width, height, camera_model)
        lenses = checked_lenses(lens, camera_model, means, covars, viewmats, settings.width, settings.height)
        return projected(viewmats, Ks, settings, lenses)

    def seen_by(
        viewmats: Tensor, Ks: Tensor, kind: CameraKind, lenses: Lenses | None, cameras: slice
    ) -> ProjectedScene:
        settings = settings_of(viewmats, Ks, kind.width, kind.height, kind.camera_model)
        return projected(viewmats, Ks, settings, lenses, cameras)

    check_is_joined()
    check_cameras(means, viewmats, Ks)
    check_choice("camera_model", camera_model)
    width, height = checked_sizes(width=width, height=height)
    lenses = checked_lenses(lens, camera_model, means, covars, viewmats, width, height)
    kind = CameraKind(width, height, camera_model, None if lenses is None else lenses.settings)
    return scene_among_ranks(seen_by, viewmats, Ks, kind, lenses, len(means))


def _of_cameras(values: Any, degree: int | None, cameras: slice) -> Any:
    """What is drawn before some of the cameras of all ranks; not checked yet. What all cameras share stays as it is."""
    if isinstance(values, tuple):
        return tuple(_of_cameras(one, degree, cameras) for one in values)
    of_each = isinstance(values, Tensor) and values.dim() == (3 if degree is None else 4)
    return values[cameras] if of_each else values
