"""Torch autograd over Warp tapes: the only file that imports both torch and warp_kernels.

Each step of the rasterizer is one ``torch.autograd.Function``. Its forward pass wraps torch's memory as Warp arrays,
runs the step and records the adjoint on a ``wp.Tape``; its backward pass lends the gradients to the arrays and replays
the tape. Torch owns every tensor that outlives a call; work runs on torch's current stream.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from warp_kernels import rasterization as steps
from warp_kernels.projection import GaussianArrays, ProjectedArrays, ProjectionSettings
from warp_kernels.tile_binning import TileBins

wp.config.log_level = wp.LOG_WARNING

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
"""Torch dtypes the kernels run in, and Warp's names for them."""

MEMPOOL_THRESHOLD = 1 << 62
"""Bytes Warp keeps for reuse on a CUDA device instead of returning them to the driver at every synchronisation."""

_prepared_devices: set[str] = set()


def wrap(tensor: Tensor, dtype: Any) -> wp.array:
    """A Warp array on a torch tensor's memory.

    Args:
        tensor: contiguous.
        dtype: Warp dtype, scalar or vector; vectors take the last dimension, matrices the last two.

    Returns:
        The array; it shares memory and does not own it.
    """
    tensor = tensor.detach()
    # Torch calls any stride of a dimension of size 1, or of an empty tensor, contiguous; Warp compares strides.
    if tensor.numel() == 0:
        tensor = tensor.new_empty(tensor.shape)
    elif tensor.shape[0] == 1:
        tensor = tensor.view(-1).view(tensor.shape)
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


@contextmanager
def on_torch_stream(device: torch.device) -> Iterator[wp.Device]:
    """Runs Warp on torch's current stream of a device.

    Args:
        device: a CPU or CUDA device.

    Yields:
        The Warp device.
    """
    wp.init()
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    warp_device = wp.device_from_torch(device)
    if not warp_device.is_cuda:
        yield warp_device
        return
    if warp_device.alias not in _prepared_devices:
        if wp.is_mempool_enabled(warp_device):
            wp.set_mempool_release_threshold(warp_device, MEMPOOL_THRESHOLD)
        _prepared_devices.add(warp_device.alias)
    with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False):
        yield warp_device


def _zeros(tensor: Tensor, wanted: bool) -> Tensor | None:
    return torch.zeros_like(tensor) if wanted else None


def _lend(array: wp.array, gradient: Tensor | None) -> None:
    """Gives an array the gradient autograd brought; None stands for zeros."""
    array.grad = wp.zeros_like(array) if gradient is None else wrap(gradient.contiguous(), array.dtype)


class Project(torch.autograd.Function):
    """Projection; see ``project``."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        covars: Tensor | None,
        opacities: Tensor,
        thermal_opacities: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        settings: ProjectionSettings,
    ) -> tuple[Tensor, ...]:
        scalar = SCALARS[means.dtype]
        vec2, vec3, vec4, vec6 = (wp.types.vector(k, scalar) for k in (2, 3, 4, 6))
        mat33, mat44 = wp.types.matrix((3, 3), scalar), wp.types.matrix((4, 4), scalar)
        entries = len(viewmats) * settings.num_gaussians
        means2d = means.new_empty(entries, 2)
        depths = means.new_empty(entries)
        conics = means.new_empty(entries, 3)
        compensations = means.new_empty(entries)
        radii = torch.empty(entries, 2, dtype=torch.int32, device=means.device)
        extents = means.new_empty(entries, 2)
        with on_torch_stream(means.device):
            ctx.gaussians = GaussianArrays(
                wrap(means, vec3),
                wrap(quats, vec4),
                wrap(scales, vec3),
                None if covars is None else wrap(covars, vec6),
                wrap(opacities, scalar),
                wrap(thermal_opacities, scalar),
                wrap(viewmats, mat44),
                wrap(Ks, mat33),
            )
            ctx.projected = ProjectedArrays(
                wrap(means2d, vec2),
                wrap(depths, scalar),
                wrap(conics, vec3),
                wrap(compensations, scalar),
                wrap(radii, wp.vec2i),
                wrap(extents, vec2),
            )
            ctx.tape = wp.Tape() if any(ctx.needs_input_grad) else None
            steps.project(ctx.gaussians, settings, ctx.projected, ctx.tape)
        ctx.mark_non_differentiable(radii, extents)
        ctx.set_materialize_grads(False)
        # Saved so that torch reports in-place changes between forward and backward.
        ctx.save_for_backward(means, quats, scales, covars, viewmats, Ks, conics, compensations, radii)
        return means2d, depths, conics, compensations, radii, extents

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        means, quats, scales, covars, viewmats, Ks = ctx.saved_tensors[:6]
        to_cameras = ctx.needs_input_grad[6] or ctx.needs_input_grad[7]
        v_means, v_quats, v_scales = (torch.zeros_like(t) for t in (means, quats, scales))
        v_covars = _zeros(covars, True) if covars is not None else None
        v_viewmats, v_Ks = _zeros(viewmats, to_cameras), _zeros(Ks, to_cameras)
        with on_torch_stream(means.device):
            g, p = ctx.gaussians, ctx.projected
            for array, grad in (
                (g.means, v_means),
                (g.quats, v_quats),
                (g.scales, v_scales),
                (g.covars, v_covars),
                (g.viewmats, v_viewmats),
                (g.Ks, v_Ks),
            ):
                if array is not None:
                    array.grad = None if grad is None else wrap(grad, array.dtype)
            outputs = (p.means2d, p.depths, p.conics, p.compensations)
            for array, gradient in zip(outputs, gradients[:4], strict=True):
                _lend(array, gradient)
            ctx.tape.backward()
        return v_means, v_quats, v_scales, v_covars, None, None, v_viewmats, v_Ks, None


class ShColors(torch.autograd.Function):
    """Colours from spherical harmonics; see ``sh_colors``."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        camera_positions: Tensor,
        coefficients: Tensor,
        radii: Tensor,
        degree: int,
        per_image: bool,
        num_gaussians: int,
        num_cameras: int,
    ) -> Tensor:
        vec3 = wp.types.vector(3, SCALARS[means.dtype])
        colors = means.new_empty(len(radii), 3)
        with on_torch_stream(means.device):
            ctx.arrays = [wrap(t, vec3) for t in (means, camera_positions, coefficients, colors)]
            ctx.tape = wp.Tape() if any(ctx.needs_input_grad) else None
            steps.sh_colors(
                degree,
                *ctx.arrays[:3],
                wrap(radii, wp.vec2i),
                ctx.arrays[3],
                num_gaussians,
                num_cameras,
                per_image,
                ctx.tape,
            )
        ctx.save_for_backward(means, camera_positions, coefficients, radii, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        means, camera_positions, coefficients = ctx.saved_tensors[:3]
        vec3 = wp.types.vector(3, SCALARS[means.dtype])
        v_means, v_coefficients = torch.zeros_like(means), torch.zeros_like(coefficients)
        v_positions = _zeros(camera_positions, ctx.needs_input_grad[1])
        with on_torch_stream(means.device):
            for array, grad in zip(ctx.arrays[:3], (v_means, v_positions, v_coefficients), strict=True):
                array.grad = None if grad is None else wrap(grad, vec3)
            _lend(ctx.arrays[3], v_colors)
            ctx.tape.backward()
        return v_means, v_positions, v_coefficients, None, None, None, None, None


@dataclass
class BlendInputs:
    """What ``Blend`` needs beside the tensors it differentiates."""

    projected: ProjectedArrays
    bins: TileBins
    settings: ProjectionSettings
    thermal_channels: int
    absgrad: bool
    means2d_holder: list[Tensor]
    """The tensor users see as info["means2d"]; its ``absgrad`` attribute is set by the backward pass."""


class Blend(torch.autograd.Function):
    """Blending with one opacity or two; see ``blend``."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        thermal_opacities: Tensor | None,
        features: Tensor,
        inputs: BlendInputs,
    ) -> tuple[Tensor, ...]:
        scalar = SCALARS[means2d.dtype]
        channels, thermal_channels = features.shape[-1], inputs.thermal_channels
        vecC = wp.types.vector(channels, scalar)
        settings = inputs.settings
        rows, width = settings.num_images * settings.height, settings.width

        def image_int() -> Tensor:
            return torch.empty(rows, width, dtype=torch.int32, device=means2d.device)

        render, transmittance, last_pairs = (
            means2d.new_empty(rows, width, channels),
            means2d.new_empty(rows, width),
            image_int(),
        )
        outputs = [render, transmittance]
        saved = [means2d, conics, opacities, thermal_opacities, features, transmittance, last_pairs]
        with on_torch_stream(means2d.device):
            blended = steps.BlendedArrays(wrap(render, vecC), wrap(transmittance, scalar), wrap(last_pairs, wp.int32))
            if thermal_channels:
                thermal = means2d.new_empty(rows, width, thermal_channels)
                thermal_transmittance, thermal_last_pairs = means2d.new_empty(rows, width), image_int()
                blended.thermal_render = wrap(thermal, wp.types.vector(thermal_channels, scalar))
                blended.thermal_transmittance = wrap(thermal_transmittance, scalar)
                blended.thermal_last_pairs = wrap(thermal_last_pairs, wp.int32)
                outputs += [thermal, thermal_transmittance]
                saved += [thermal_transmittance, thermal_last_pairs]
            ctx.absolute = torch.zeros_like(means2d) if inputs.absgrad else None
            vec2 = wp.types.vector(2, scalar)
            ctx.projected = inputs.projected
            ctx.opacities = wrap(opacities, scalar)
            ctx.thermal_opacities = ctx.opacities if thermal_opacities is None else wrap(thermal_opacities, scalar)
            ctx.features = wrap(features, vecC)
            ctx.blended = blended
            ctx.tape = wp.Tape() if any(ctx.needs_input_grad) else None
            steps.blend(
                ctx.projected,
                ctx.opacities,
                ctx.thermal_opacities,
                ctx.features,
                inputs.bins,
                settings,
                blended,
                ctx.tape,
                absolute=None if ctx.absolute is None else wrap(ctx.absolute, vec2),
            )
        ctx.means2d_holder = inputs.means2d_holder
        ctx.save_for_backward(*saved)
        return tuple(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, opacities, thermal_opacities, features = ctx.saved_tensors[:5]
        grads = [torch.zeros_like(t) for t in (means2d, conics, opacities, features)]
        v_means2d, v_conics, v_opacities, v_features = grads
        v_thermal = _zeros(thermal_opacities, True) if thermal_opacities is not None else None
        with on_torch_stream(means2d.device):
            targets = [ctx.projected.means2d, ctx.projected.conics, ctx.opacities, ctx.features]
            for array, grad in zip(targets, grads, strict=True):
                array.grad = wrap(grad, array.dtype)
            if v_thermal is not None:
                ctx.thermal_opacities.grad = wrap(v_thermal, ctx.thermal_opacities.dtype)
            blended = ctx.blended
            images = [blended.render, blended.transmittance, blended.thermal_render, blended.thermal_transmittance]
            for array, gradient in zip(images, gradients, strict=False):
                _lend(array, gradient)
            if ctx.absolute is not None:
                ctx.absolute.zero_()
            ctx.tape.backward()
        if ctx.absolute is not None:
            holder = ctx.means2d_holder[0]
            holder.absgrad = ctx.absolute.reshape(holder.shape)
        return v_means2d, v_conics, v_opacities, v_thermal, v_features, None


def bin_tiles(
    means2d: Tensor,
    conics: Tensor,
    depths: Tensor,
    compensations: Tensor,
    radii: Tensor,
    extents: Tensor,
    opacities: Tensor,
    thermal_opacities: Tensor,
    features: Tensor,
    settings: ProjectionSettings,
    tile_size: int,
) -> tuple[ProjectedArrays, TileBins]:
    """Lists the Gaussians of each tile; ``radii`` of Gaussians with non-finite features become zero.

    Args:
        means2d: [images · N, 2], px.
        conics: [images · N, 3], 1/px².
        depths: [images · N], world units.
        compensations: [images · N].
        radii: int32 [images · N, 2], px. Changed in place.
        extents: [images · N, 2], px.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same tensor where there is one opacity.
        features: [images · N, D].
        settings: image size.
        tile_size: edge of a tile [px].

    Returns:
        The projected arrays for ``Blend`` and the bins.
    """
    scalar = SCALARS[means2d.dtype]
    vec2, vec3 = wp.types.vector(2, scalar), wp.types.vector(3, scalar)
    with on_torch_stream(means2d.device) as device:
        projected = ProjectedArrays(
            wrap(means2d, vec2),
            wrap(depths, scalar),
            wrap(conics, vec3),
            wrap(compensations, scalar),
            wrap(radii, wp.vec2i),
            wrap(extents, vec2),
        )
        bins = steps.bin_tiles(
            projected,
            wrap(opacities, scalar),
            wrap(thermal_opacities, scalar),
            wrap(features, scalar),
            settings,
            tile_size,
            by_slot=not device.is_cuda,
        )
    return projected, bins


def to_torch(array: wp.array) -> Tensor:
    """A torch tensor on a Warp array's memory, which it keeps alive."""
    return wp.to_torch(array, requires_grad=False)
