"""Where the time goes: the steps of warp_kernels one by one, without torch's autograd around them."""

from collections.abc import Callable

import torch
import warp as wp
from timing import time_interleaved
from torch import Tensor

from thermosplat.warp_bridge import on_torch_stream, wrap
from warp_kernels.binning_step import bin_tiles
from warp_kernels.blending_step import BlendedArrays, blend
from warp_kernels.projection import GaussianArrays, ProjectionSettings
from warp_kernels.projection_step import project
from warp_kernels.rasterization import allocate_projected, scalar_view


def stage_times(
    inputs: dict[str, Tensor], width: int, height: int, repeats: int
) -> tuple[dict[str, dict[str, float]], int]:
    """Times projection, binning and blending and their adjoints on one image of float32 features.

    Args:
        inputs: means, quats, scales, opacities, features, and thermal_opacities for two opacities.
        width: image width [px].
        height: image height [px].
        repeats: measurements of each stage.

    Returns:
        For each stage the median and spread [ms], and the number of (Gaussian, tile) pairs.
    """
    device = inputs["means"].device
    with on_torch_stream(device) as warp_device:
        detached = {name: tensor.detach() for name, tensor in inputs.items()}
        calls, pairs = _stages(detached, width, height, warp_device)
        return {name: time_interleaved({name: call}, device, repeats)[name] for name, call in calls.items()}, pairs


def _stages(
    t: dict[str, Tensor], width: int, height: int, device: wp.Device
) -> tuple[dict[str, Callable[[], object]], int]:
    dtype, vector, matrix = wp.float32, wp.types.vector, wp.types.matrix
    dual = "thermal_opacities" in t
    # The RGB + thermal frame blends the 3 colours too; any numbers will do for a time.
    features_t = torch.cat([t["means"], t["features"]], -1).contiguous() if dual else t["features"]
    count, channels = features_t.shape
    thermal_channels = t["features"].shape[-1] if dual else 0

    def array(tensor: Tensor, kind: type) -> wp.array:
        made = wrap(tensor.contiguous(), kind)
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
        array(t["viewmats"], matrix((4, 4), dtype)),
        array(t["Ks"], matrix((3, 3), dtype)),
    )
    features = array(features_t, vector(channels, dtype))
    settings = ProjectionSettings(width=width, height=height, num_gaussians=count, num_cameras=1, num_images=1)

    def image(kind: type, requires_grad: bool = True) -> wp.array:
        return wp.zeros((height, width), dtype=kind, device=device, requires_grad=requires_grad)

    blended = BlendedArrays(image(vector(channels, dtype)), image(dtype), image(wp.int32, False))
    if dual:
        blended.thermal_render = image(vector(thermal_channels, dtype))
        blended.thermal_transmittance, blended.thermal_last_pairs = image(dtype), image(wp.int32, False)
    projected = allocate_projected(count, dtype, device, True)
    project_tape, blend_tape = wp.Tape(), wp.Tape()
    project(gaussians, settings, projected, project_tape)

    def binning():
        return bin_tiles(projected, opacities, thermal, scalar_view(features), settings, 16, by_slot=not device.is_cuda)

    bins = binning()
    blend(projected, opacities, thermal, features, bins, settings, blended, blend_tape)
    for output in (blended.render, blended.transmittance, blended.thermal_render, blended.thermal_transmittance):
        if output is not None:
            output.grad.fill_(0.01)
    calls: dict[str, Callable[[], object]] = {
        "projection": lambda: project(gaussians, settings, projected),
        "binning": binning,
        "blending": lambda: blend(projected, opacities, thermal, features, bins, settings, blended),
        "blending adjoint": blend_tape.backward,
        "projection adjoint": project_tape.backward,
    }
    return calls, bins.num_pairs
