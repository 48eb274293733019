"""Torch autograd over the blending along rays, gsplat's ``with_eval3d``."""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import check_shape
from thermosplat.rasterizer.blending_autograd import TileLists
from thermosplat.rasterizer.call_inputs import Cameras, Splats
from thermosplat.rasterizer.projected_scene import ProjectedScene
from thermosplat.rasterizer.rays import pixel_rays, whitening
from thermosplat.torch_bridge.arrays import kinds_of, vector_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.blending.ray_blending import RayVariant, ray_blend_adjoint_kernel, ray_blend_kernel
from warp_kernels.machinery.launching import launch, launch_again


class RayImages(NamedTuple):
    """What ``blend_along_rays`` returns, [..., C, H, W, channels]."""

    render: Tensor
    hits: Tensor | None
    """Sums of weights times distances along the rays, world units."""
    normals: Tensor | None
    """Sums of weights times third axes, turned towards the rays' origins."""
    transmittance: Tensor


def check_ray_arguments(with_eval3d: bool, *, needs: dict[str, bool], excludes: dict[str, bool]) -> None:
    """Checks what needs blending along rays, and what does not go with it.

    Args:
        with_eval3d: Whether rays are asked for.
        needs: By an argument as the caller wrote it, whether it was given and needs rays.
        excludes: Likewise, whether it was given and does not go with rays.

    Raises:
        UserError: naming the first of them.
    """
    for words, asked in needs.items():
        if asked and not with_eval3d:
            raise UserError(f"{words} needs with_eval3d=True, as in gsplat.", "Give with_eval3d=True.")
    for words, asked in excludes.items():
        if asked and with_eval3d:
            raise UserError(f"{words} does not go with with_eval3d=True.", f"Leave {words} out, or with_eval3d.")


def blend_along_rays(
    scene: ProjectedScene,
    splats: Splats,
    cameras: Cameras,
    features: Tensor,
    chunk: int,
    *,
    rays: Tensor | None,
    hits: bool,
    normals: bool,
) -> RayImages:
    """Blends features, and what rays know of Gaussians, in the order and the tiles of a projection.

    Args:
        cameras: Its cameras, of which rays are made where none are given.
        features: [images · N, D].
        rays: Origin and direction of every pixel, [..., C, H, W, 6]; or None.

    Raises:
        UserError: the rays have the wrong shape.
    """
    means, settings = splats.means, scene.settings
    lists = scene.binned(features)
    shape = (*scene.images_shape, settings.height, settings.width)
    if rays is None:
        origins, directions = pixel_rays(
            cameras.viewmats, cameras.Ks, settings.width, settings.height, cameras.camera_model
        )
    else:
        check_shape("rays", rays, (*shape, 6), means, "[..., C, H, W, 6]")
        origins, directions = rays[..., :3].double(), rays[..., 3:]
    quats, scales = cast("Tensor", splats.quats), cast("Tensor", splats.scales)  # there are no covariances here
    # A Gaussian without an extent along an axis has no response between planes: it is not drawn.
    visible = scene.projected.visible.any(-2) & (scales != 0).all(-1)
    opacities = torch.where(visible.unsqueeze(-2), scene.opacities, 0.0)
    whitenings, axes = whitening(quats, scales, visible)
    tensors = (origins, directions.to(means.dtype), means, whitenings, axes, opacities)
    images: list[tuple[Tensor, ...]] = []
    parts: Sequence[Tensor] = features.split(chunk, -1) if features.shape[-1] > chunk else [features]
    for number, part in enumerate(parts):
        first = number == 0
        inputs = RayInputs(scene, lists, hits and first, normals and first)
        images.append(BlendRays.apply(*(one.contiguous() for one in tensors), part.contiguous(), inputs))
    render = images[0][0] if len(images) == 1 else torch.cat([image[0] for image in images], -1)
    _, distances, directions, transmittance = images[0]
    return RayImages(render, distances if hits else None, directions if normals else None, transmittance)


class RayInputs(NamedTuple):
    """What ``BlendRays`` needs beside the tensors that it differentiates."""

    scene: ProjectedScene
    lists: TileLists
    hits: bool
    normals: bool


class BlendRays(torch.autograd.Function):
    """Blending along rays; see ``warp_kernels.blending.ray_blending``. Returns the fields of ``RayImages``."""

    @staticmethod
    def forward(
        ctx: Any,
        origins: Tensor,
        directions: Tensor,
        means: Tensor,
        whitenings: Tensor,
        axes: Tensor,
        opacities: Tensor,
        features: Tensor,
        inputs: RayInputs,
    ) -> tuple[Tensor, ...]:
        """Images of features, distances, axes and transmittance."""
        settings, lead = inputs.scene.settings, directions.shape[:-1]
        ctx.inputs, ctx.settings = None, settings
        scalar = kinds_of(features.dtype).scalar
        ctx.variant = RayVariant(features.shape[-1], inputs.hits, inputs.normals, scalar)
        ctx.counts = _counts(inputs)
        ctx.tile_lists = inputs.lists.tensors["gaussian_ids"], inputs.lists.tensors["tile_offsets"]
        render = means.new_empty((*lead, features.shape[-1]))
        hits = means.new_empty((*lead, 1) if inputs.hits else (0,))
        normals = means.new_empty((*lead, 3) if inputs.normals else (0, 3))
        transmittance = means.new_empty((*lead, 1))
        last_pairs = torch.empty(lead, dtype=torch.int32, device=means.device)
        read = (origins, directions, means, whitenings, axes, opacities, features, *ctx.tile_lists)
        outputs = (render, hits, normals, transmittance, last_pairs)
        kinds = kinds_of(means.dtype)
        written = [kinds.vec3 if one is normals else _kind(one) for one in outputs]
        written[0] = vector_of(features.shape[-1], means.dtype)
        with launches_on_torch_stream(means.device) as device:
            arrays = [view(one, kind) for one, kind in zip(outputs, written, strict=True)]
            launch(ray_blend_kernel(ctx.variant), lead.numel(), [*ctx.counts, *_arrays(read), *arrays], device)
        ctx.mark_non_differentiable(last_pairs)
        ctx.save_for_backward(*read[:7], transmittance, last_pairs)
        return render, hits, normals, transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients to rays, Gaussians, opacities and features."""
        *tensors, transmittance, last_pairs = ctx.saved_tensors
        v_origins, v_directions = torch.empty_like(tensors[1]), torch.empty_like(tensors[1])
        found = [torch.zeros_like(one) for one in tensors[2:]]
        kinds, channels = kinds_of(tensors[1].dtype), tensors[6].shape[-1]
        v_render, v_hits, v_normals, v_transmittance = (gradient.contiguous() for gradient in gradients)
        given = [
            view(v_render, vector_of(channels, v_render.dtype)),
            view(v_hits, kinds.scalar),
            view(v_normals, kinds.vec3),
            view(v_transmittance, kinds.scalar),
        ]
        written = [view(v_origins, kinds.vec3), view(v_directions, kinds.vec3), *_gaussian_arrays(*found)]
        with launches_on_torch_stream(transmittance.device) as device:
            read = [
                *_arrays((*tensors, *ctx.tile_lists)),
                view(transmittance, kinds.scalar),
                view(last_pairs, wp.int32),
            ]
            kernel = ray_blend_adjoint_kernel(ctx.variant)
            launch_again(kernel, last_pairs.numel(), [*ctx.counts, *read, *given, *written], device)
        return v_origins.to(tensors[0].dtype), v_directions, *found, None


def _counts(inputs: RayInputs) -> list[int]:
    """The numbers that both kernels begin with."""
    bins, settings = inputs.lists.bins, inputs.scene.settings
    tiles = [bins.tiles_x, bins.tiles_y, bins.tile_size]
    return [*tiles, settings.width, settings.height, settings.num_gaussians, settings.num_cameras]


def _kind(tensor: Tensor) -> Any:
    return wp.int32 if tensor.dtype == torch.int32 else kinds_of(tensor.dtype).scalar


def _arrays(read: Sequence[Tensor]) -> list[Any]:
    """Rays, Gaussians and lists as arrays."""
    origins, directions, *gaussians, gaussian_ids, tile_offsets = read
    rays = [view(origins, wp.vec3d), view(directions, kinds_of(directions.dtype).vec3)]
    return [*rays, *_gaussian_arrays(*gaussians), view(gaussian_ids, wp.int32), view(tile_offsets, wp.int32)]


def _gaussian_arrays(means: Tensor, whitenings: Tensor, axes: Tensor, opacities: Tensor, features: Tensor) -> list[Any]:
    kinds = kinds_of(means.dtype)
    features_kind = vector_of(features.shape[-1], means.dtype)
    shapes = ((means, kinds.vec3), (whitenings, kinds.mat33), (axes, kinds.vec3), (opacities, kinds.scalar))
    return [*(view(one, kind) for one, kind in shapes), view(features, features_kind)]
