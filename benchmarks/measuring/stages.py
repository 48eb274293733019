"""Where the time goes: the steps of warp_kernels one by one, without torch's autograd around them."""

from collections.abc import Callable

import torch
import warp as wp
from torch import Tensor

from measuring.timing import time_interleaved
from thermosplat.torch_bridge.streams import on_torch_stream
from warp_kernels.binning.binning_step import bin_tiles
from warp_kernels.blending.blended_arrays import BlendedArrays
from warp_kernels.blending.blending_step import blend
from warp_kernels.color.color_step import ColorArrays, ColorSettings, sh_colors, sh_colors_adjoint
from warp_kernels.projection.plain_camera_step import project_gaussians, project_gaussians_adjoint
from warp_kernels.projection.projection import GaussianArrays, ProjectionSettings
from warp_kernels.rasterization import allocate_projected, scalar_view


def blended_channels(inputs: dict[str, Tensor]) -> tuple[int, int]:
    """Channels a case blends at the first opacity, and at the second (0 where there is one)."""
    features = inputs["features"].shape[-1] if "features" in inputs else 0
    return (3 if "sh" in inputs else 0) + features, features if "thermal_opacities" in inputs else 0


def stage_times(inputs: dict[str, Tensor], width: int, height: int, repeats: int) -> dict[str, dict[str, float]]:
    """Times each step and its adjoint on one image in float32.

    On a GPU the host runs ahead of the device, so that these are times of the kernels (in the binning, which reads the
    number of pairs back, also of the wait).

    Args:
        inputs: means, quats, scales, opacities, viewmats, Ks, and sh [N, 16, 3] or features or both;
            thermal_opacities for two opacities.
        width: image width [px].
        height: image height [px].
        repeats: measurements of each stage.

    Returns:
        For each stage the median and spread [ms].
    """
    device = inputs["means"].device
    with on_torch_stream(device) as warp_device:
        detached = {name: tensor.detach() for name, tensor in inputs.items()}
        calls = _stages(detached, width, height, warp_device)
        return {
            name: time_interleaved({name: call}, device, repeats, hide_host=True)[name] for name, call in calls.items()
        }


def _stages(t: dict[str, Tensor], width: int, height: int, device: wp.Device) -> dict[str, Callable[[], object]]:
    dtype, vector, matrix = wp.float32, wp.types.vector, wp.types.matrix
    dual = "thermal_opacities" in t
    channels, thermal_channels = blended_channels(t)
    count = len(t["means"])

    def array(tensor: Tensor, kind: type) -> wp.array:
        made = wp.from_torch(tensor, kind)
        made.requires_grad = True
        return made

    opacities = array(t["opacities"], dtype)
    thermal = array(t["thermal_opacities"], dtype) if dual else opacities
    gaussians = GaussianArrays(
        array(t["means"], vector(3, dtype)),
        array(t["quats"], vector(4, dtype)),
        array(t["scales"], vector(3, dtype)),
        None,
        opacities,
        thermal,
        wp.from_torch(t["viewmats"], matrix((4, 4), dtype)),
        wp.from_torch(t["Ks"], matrix((3, 3), dtype)),
    )
    settings = ProjectionSettings(width=width, height=height, num_gaussians=count, num_cameras=1, num_images=1)
    projected = allocate_projected(count, dtype, device, True)
    calls: dict[str, Callable[[], object]] = {}
    adjoints: dict[str, Callable[[], object]] = {}

    # Gradients of Gaussians are stored and not added, as torch's functions ask for them.
    project_gaussians(gaussians, settings, projected)
    calls["projection"] = lambda: project_gaussians(gaussians, settings, projected)
    adjoints["projection adjoint"] = lambda: project_gaussians_adjoint(
        gaussians, settings, projected, store=True, add_to_means="sh" in t
    )

    parts = [t["features"]] if "features" in t else []
    if "sh" in t:
        colors = wp.empty(count, dtype=vector(3, dtype), device=device, requires_grad=True)
        v_sh = torch.empty_like(t["sh"])
        coefficients = []
        for part in (slice(0, 1), slice(1, None)):
            coefficients.append(wp.from_torch(t["sh"][:, part], vector(3, dtype)))
            coefficients[-1].grad = wp.from_torch(v_sh[:, part], vector(3, dtype))
        arrays = ColorArrays(gaussians.means, gaussians.viewmats, *coefficients, projected.visible, colors)
        color_settings = ColorSettings(3, count, 1)
        sh_colors(arrays, color_settings)
        colors.grad.fill_(0.01)
        calls["colors"] = lambda: sh_colors(arrays, color_settings)
        adjoints["colors adjoint"] = lambda: sh_colors_adjoint(arrays, color_settings, store=True)
        parts.insert(0, wp.to_torch(colors, requires_grad=False))
    features = array(torch.cat(parts, -1), vector(channels, dtype))

    def image(kind: type, requires_grad: bool = True) -> wp.array:
        return wp.zeros((height, width), dtype=kind, device=device, requires_grad=requires_grad)

    blended = BlendedArrays(image(vector(channels, dtype)), image(dtype), image(wp.int32, False))
    if dual:
        blended.thermal_render = image(vector(thermal_channels, dtype))
        blended.thermal_transmittance, blended.thermal_ends = image(dtype), image(wp.int32, False)

    def binning():
        return bin_tiles(projected, opacities, thermal, scalar_view(features), settings, 16, by_slot=not device.is_cuda)

    bins, blend_tape = binning(), wp.Tape()
    blend(projected, opacities, thermal, features, bins, settings, blended, blend_tape)
    for output in (blended.render, blended.transmittance, blended.thermal_render, blended.thermal_transmittance):
        if output is not None:
            gradient = wp.to_torch(output.grad)
            gradient.copy_(torch.randn(gradient.shape, device=gradient.device))
    calls["binning"] = binning
    calls["blending"] = lambda: blend(projected, opacities, thermal, features, bins, settings, blended)
    adjoints["blending adjoint"] = blend_tape.backward
    return calls | dict(reversed(adjoints.items()))
