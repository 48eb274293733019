"""From a call's Gaussians and cameras to the scene that is blended: arguments are checked, and Gaussians projected."""

import functools
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from thermosplat.distributed.collectives import check_is_joined
from thermosplat.rasterizer.arguments import PLAIN_MODELS, check_choice, checked_settings
from thermosplat.rasterizer.blended_values import check_values
from thermosplat.rasterizer.call_inputs import (
    PLAIN,
    BlendedValues,
    CameraModel,
    Cameras,
    Drawn,
    LensArguments,
    RasterizeMode,
    Splats,
)
from thermosplat.rasterizer.cameras_of_ranks import CameraKind, check_cameras
from thermosplat.rasterizer.checked_numbers import checked_sizes
from thermosplat.rasterizer.exchanged_scene import scene_among_ranks
from thermosplat.rasterizer.info import num_nonfinite
from thermosplat.rasterizer.lenses import Lenses, checked_lenses
from thermosplat.rasterizer.projected_scene import ProjectedScene
from thermosplat.rasterizer.projection_autograd import Harmonics, Project, ProjectedTensors, ProjectInputs
from thermosplat.torch_bridge.arrays import kinds_of, view, warp_device_of
from warp_kernels.color.color_step import ColorSettings
from warp_kernels.machinery.array_views import ArrayView

_color_settings = functools.lru_cache(maxsize=256)(ColorSettings)
_project_unrecorded = functools.partial(Project.forward, None)


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
    drawn: Mapping[str, tuple[Any, ...]] | None = None,
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

    For code that reads the projection or blends itself. Arguments that are not described here are those of
    ``rasterization``.

    Args:
        drawn: What may be blended, by name: values [..., (C,) N, X] and None, or coefficients of spherical harmonics
            (as ``rasterization``'s colors) and their active degree. ``features`` of the scene are their final values,
            in this order, each [images · N, X].
        thermal_opacities: Second opacities, [..., N]; None: there is one opacity.
        lens: The arguments of ``rasterization`` that describe lenses and shutters.

    Returns:
        The scene: what was projected (``projected``), ``features``, and ``blend``.

    Raises:
        UserError: if an argument has the wrong shape, type or device.
    """
    values = {name: BlendedValues(*given) for name, given in (drawn or {}).items()}
    return scene_of(
        Splats(means, quats, scales, opacities, covars, thermal_opacities),
        Cameras(viewmats, Ks, width, height, near_plane, far_plane, camera_model, lens),
        Drawn(values, radius_clip, eps2d, tile_size, rasterize_mode, deterministic, global_z_order, distributed),
    )


def scene_of(splats: Splats, cameras: Cameras, drawn: Drawn) -> ProjectedScene:
    """The scene of a call.

    Args:
        splats: As given, not checked yet, as are the others.
        cameras: Likewise.
        drawn: Likewise.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    if drawn.distributed:
        return _among_ranks(splats, cameras, drawn)
    settings, tile_size = checked_settings(splats, cameras, drawn)
    lenses = None
    if cameras.lens != PLAIN or cameras.camera_model not in PLAIN_MODELS:
        lenses = checked_lenses(splats, cameras, settings.width, settings.height)
    return _projected(splats, cameras, drawn, lenses, settings, tile_size)


def _among_ranks(splats: Splats, cameras: Cameras, drawn: Drawn) -> ProjectedScene:
    """What this rank's cameras see of the Gaussians of all ranks, each of which projects its own to all cameras."""

    def seen_by(alike: Cameras, lenses: Lenses | None, which: slice) -> ProjectedScene:
        theirs = {name: one._replace(values=_of_cameras(one, which)) for name, one in drawn.values.items()}
        settings, tile_size = checked_settings(splats, alike, drawn)
        return _projected(splats, alike, drawn._replace(values=theirs), lenses, settings, tile_size)

    check_is_joined()
    check_cameras(splats.means, cameras.viewmats, cameras.Ks)
    check_choice("camera_model", cameras.camera_model)
    width, height = checked_sizes(width=cameras.width, height=cameras.height)
    lenses = checked_lenses(splats, cameras, width, height)
    kind = CameraKind(width, height, cameras.camera_model, None if lenses is None else lenses.settings)
    return scene_among_ranks(seen_by, cameras, kind, lenses, len(splats.means))


def _of_cameras(one: BlendedValues, which: slice) -> Any:
    """Values before some of the cameras of all ranks; not checked yet. What all cameras share stays as it is."""
    if isinstance(one.values, tuple):
        return tuple(_of_cameras(one._replace(values=part), which) for part in one.values)
    of_each = isinstance(one.values, Tensor) and one.values.dim() == (3 if one.sh_degree is None else 4)
    return one.values[which] if of_each else one.values


def _projected(
    splats: Splats, cameras: Cameras, drawn: Drawn, lenses: Lenses | None, settings: Any, tile_size: int
) -> ProjectedScene:
    """The scene of checked Gaussians and cameras; what is blended is checked here."""
    means, quats, scales, opacities, covars, thermal_opacities = splats
    count, number = settings.num_gaussians, settings.num_cameras
    images_shape = (*means.shape[:-2], number)
    evaluated: list[Harmonics] = []
    final: list[Tensor | None] = []  # None where harmonics have to be summed
    for name, (values, degree, clamped) in drawn.values.items():
        per_camera = check_values(name, values, degree, means, number)
        if degree is None:
            final.append(_per_image(values, images_shape, per_camera))
            continue
        sh0, shN = values if isinstance(values, tuple) else (values, None)
        shN = None if shN is None or shN.shape[-2] == 0 else shN.contiguous()
        how = _color_settings(degree, count, number, per_camera, clamped=clamped)
        evaluated.append(Harmonics(sh0.contiguous(), shN, how))
        final.append(None)
    if covars is not None:
        quats = scales = None
        covars = upper_triangles(covars)
    opacities = opacities.contiguous()
    scalar, rows, device = kinds_of(means.dtype).scalar, (opacities.numel(),), warp_device_of(means.device)
    bound = second = ArrayView(opacities.data_ptr(), rows, scalar, device)
    if thermal_opacities is not None:
        thermal_opacities = thermal_opacities.contiguous()
        second = ArrayView(thermal_opacities.data_ptr(), rows, scalar, device)
    viewmats, turns = cameras.viewmats if lenses is None else lenses.viewmats, threading.Lock()
    color_settings = tuple([one.settings for one in evaluated])
    how_seen = None if lenses is None else lenses.settings
    inputs = ProjectInputs(bound, second, settings, color_settings, images_shape, turns, how_seen)
    recorded = torch.is_grad_enabled() or forward_ad._current_level >= 0
    means2d, depths, roots, compensations, *colors, others, arrays = (
        Project.apply if recorded else _project_unrecorded
    )(
        means.contiguous(),
        None if quats is None else quats.contiguous(),
        None if scales is None else scales.contiguous(),
        covars,
        viewmats.contiguous(),
        cameras.Ks.contiguous(),
        None if lenses is None else lenses.coefficients.contiguous(),
        None if lenses is None or lenses.motions is None else lenses.motions.contiguous(),
        inputs,
        *[coefficients for one in evaluated for coefficients in one[:2]],
    )
    projected = ProjectedTensors(means2d, depths, roots, compensations, *others)
    if not drawn.global_z_order:
        projected = projected._replace(depths=distances(means, viewmats, projected.visible))
        arrays = replace(arrays, depths=view(projected.depths, scalar))
    summed = iter(colors)
    return ProjectedScene(
        projected,
        arrays,
        _per_camera(opacities, images_shape, compensations),
        None if thermal_opacities is None else _per_camera(thermal_opacities, images_shape, compensations),
        [next(summed) if one is None else one for one in final],
        settings,
        images_shape,
        tile_size,
        turns,
        deterministic=drawn.deterministic,
        num_nonfinite=Given(splats, cameras, drawn, lenses).num_nonfinite,
    )


def _per_image(values: Tensor, images_shape: tuple[int, ...], per_camera: bool) -> Tensor:
    """Final values [..., (C,) N, X] flat, repeated for each camera where they are shared."""
    if not per_camera and images_shape[-1] != 1:
        values = values.unsqueeze(-3).expand(*images_shape, *values.shape[-2:])
    if values.dim() != 2:
        values = values.reshape(-1, values.shape[-1])
    return values.contiguous()


def _per_camera(opacities: Tensor, images_shape: tuple[int, ...], compensations: Tensor | None) -> Tensor:
    """Opacities [..., N] as they are blended, [..., C, N]."""
    opacities = opacities.unsqueeze(-2)
    if images_shape[-1] != 1:
        opacities = opacities.expand(*images_shape, -1)
    return (opacities if compensations is None else opacities * compensations).contiguous()


def upper_triangles(covars: Tensor) -> Tensor:
    """xx, xy, xz, yy, yz and zz, [..., N, 6], of covariances [..., N, 3, 3], or of what they already are."""
    if covars.shape[-1] == 6:
        return covars.contiguous()
    return torch.cat([covars[..., 0, :], covars[..., 1, 1:], covars[..., 2, 2:]], -1)


class Given(NamedTuple):
    """What a scene was made of, to be looked at when somebody asks."""

    splats: Splats
    cameras: Cameras
    drawn: Drawn
    lenses: Lenses | None

    def num_nonfinite(self) -> int:
        """Gaussians that something not finite makes invisible; see ``info.num_nonfinite``."""
        means, quats, scales, opacities, covars, thermal_opacities = self.splats
        read = [(means, 3), (opacities, 1)]
        if covars is not None:
            read.append((upper_triangles(covars), 6))
        elif quats is not None and scales is not None:
            read += [(quats, 4), (scales, 3)]
        if thermal_opacities is not None:
            read.append((thermal_opacities, 1))
        for values, degree, _ in self.drawn.values.values():
            read += [(values, values.shape[-1])] if degree is None else _active(values, degree)
        cameras = [self.cameras.viewmats, self.cameras.Ks]
        if self.lenses is not None:
            cameras += [tensor for tensor in self.lenses[1:] if tensor is not None]
        return num_nonfinite(read, cameras, math.prod(means.shape[:-2]), means.shape[-2])


def _active(values: Tensor | Sequence[Tensor], degree: int) -> list[tuple[Tensor, int]]:
    """The coefficients of active degrees, each tensor with its number of values per Gaussian."""
    active = (degree + 1) ** 2
    if isinstance(values, Tensor):
        return [(values[..., :active, :], 3 * active)]
    sh0, shN = values
    return [(sh0, 3), (shN[..., : active - 1, :], 3 * (active - 1))]


def distances(means: Tensor, viewmats: Tensor, visible: Tensor) -> Tensor:
    """Euclidean distances between Gaussians and cameras, differentiable in both.

    Args:
        means: Centres, [..., N, 3], world units.
        viewmats: World to camera, [..., C, 4, 4].
        visible: Which Gaussians a camera draws, [..., C, N].

    Returns:
        [..., C, N], world units; 0 where a Gaussian is not drawn. In the dtype of ``means``; in between float64, as far
        from the origin the terms cancel.
    """
    rotations, translations = viewmats[..., :3, :3].double(), viewmats[..., :3, 3].double()
    seen = torch.where(visible[..., None], means.double().unsqueeze(-3), 0.0)
    positions = seen @ rotations.transpose(-1, -2) + translations.unsqueeze(-2)
    drawn = torch.where(visible[..., None], positions, 1.0)  # keeps the root's gradient finite where nothing is drawn
    lengths = torch.linalg.vector_norm(drawn, dim=-1)
    return torch.where(visible, lengths, 0.0).to(means.dtype)
