"""Mip-Splatting's 3D smoothing filter (Yu et al. 2024, section 5.1): no Gaussian is finer than training images resolve.

Notation: a camera of focal length [px] samples what lies at a depth with the rate ν = focal / depth [px per world
unit]. A Gaussian is smoothed by one of variance s / ν², s = 0.2, where ν is the largest rate of the training cameras
that see it: each scale becomes sqrt(scale² + s / ν²), and the opacity takes the factor sqrt(|Σ| / |Σ + s / ν²|), so
that its integral over space stays as it was.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from thermosplat.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from thermosplat.datasets.cameras import Camera
    from thermosplat.datasets.capture import Capture

VARIANCE = 0.2
"""s [squared sampling intervals]. Mip-Splatting."""
MARGIN = 0.15
"""A camera also sees what lies outside of its image by so much of the image's sides. Mip-Splatting's code."""
NEAR = 0.01
"""Smallest depth that is seen [world units]: the rasterizer's ``near_plane``."""
_EPSILON = 1e-6
"""Filtered opacities are stored this far from 0 and 1, where their logits are infinite."""


class SamplingCamera(NamedTuple):
    """A training camera: its pose from scene to camera, [4, 4] float64 on the CPU, and its intrinsics."""

    viewmat: Tensor
    camera: "Camera"


def sampling_cameras(capture: "Capture", set_of: Mapping[str, str]) -> dict[str, list[SamplingCamera]]:
    """The training cameras of the spectra that each set of Gaussians renders, by name of the set.

    Args:
        capture: Its training frames are taken, with cameras as the capture has them.
        set_of: By spectrum that is modelled, the name of the set that renders it.
    """
    found: dict[str, list[SamplingCamera]] = {name: [] for name in set_of.values()}
    for frame in capture.train:
        of_frame = {(set_of[name], group) for group in frame.shared_cameras for name in group if name in set_of}
        for set_name, group in sorted(of_frame):
            view = frame.views[group[0]]
            found[set_name].append(SamplingCamera(torch.as_tensor(view.viewmat), view.camera))
    return found


@torch.no_grad()
def sampling_rates(means: Tensor, cameras: Sequence[SamplingCamera]) -> Tensor:
    """Largest ν of the cameras that see a mean [px per world unit], [N]; 0 where none does.

    Args:
        means: [N, 3] [world units].
    """
    rates = means.new_zeros(len(means))
    for viewmat, camera in cameras:
        pose = viewmat.to(means)
        x, y, depth = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
        seen = depth > NEAR
        for position, focal, center, size in (
            (x, camera.fx, camera.cx, camera.width),
            (y, camera.fy, camera.cy, camera.height),
        ):
            pixels = focal * position / depth + center
            seen &= (pixels >= -MARGIN * size) & (pixels <= (1.0 + MARGIN) * size)
        rates = torch.maximum(rates, torch.where(seen, max(camera.fx, camera.fy) / depth, 0.0))
    return rates


@torch.no_grad()
def filter_deviations(means: Tensor, cameras: Sequence[SamplingCamera]) -> Tensor:
    """Standard deviation sqrt(s) / ν of each Gaussian's filter [world units], [N].

    What no camera sees gets the widest filter of what one sees, as in Mip-Splatting's code; none where nothing is seen.
    """
    rates = sampling_rates(means, cameras)
    if not len(rates):
        return rates
    least = torch.where(rates > 0, rates, torch.inf).amin()
    return VARIANCE**0.5 / torch.where(rates > 0, rates, least)


def set_filter(gaussians: Gaussians, cameras: Sequence[SamplingCamera]) -> None:
    """Fit a set's filter to where its Gaussians are now, in place where their number is what it was.

    Recorded steps go on reading the same tensor, then; with another number they were forgotten with the parameters.
    """
    found = filter_deviations(gaussians.means.detach(), cameras)
    if gaussians.filter_3d is not None and gaussians.filter_3d.shape == found.shape:
        gaussians.filter_3d.copy_(found)
    else:
        gaussians.filter_3d = found


def filtered(scales: Tensor, deviations: Tensor) -> tuple[Tensor, Tensor]:
    """What the filter makes of Gaussians; differentiable with respect to the scales, and good for captured steps.

    Args:
        scales: [N, 3] [world units].
        deviations: Of the filter, [N] [world units].

    Returns:
        Scales of the smoothed Gaussians, [N, 3], and what their opacities are multiplied by, in (0, 1], [N].
    """
    smoothed = (scales.square() + deviations.square()[:, None]).sqrt()
    # no prod(), whose adjoint waits for the device
    first, second, third = (scales / smoothed).unbind(-1)
    return smoothed, first * second * third


@torch.no_grad()
def opacity_factors(gaussians: Gaussians) -> Tensor | None:
    """What the filter multiplies a set's opacities by, float64 [N]; None: it has no filter."""
    if gaussians.filter_3d is None:
        return None
    return filtered(gaussians.log_scales.double().exp(), gaussians.filter_3d.double())[1]


@torch.no_grad()
def store_filtered(gaussians: Gaussians) -> None:
    """Make the filter part of a set's scales and opacities, which renders the same without it."""
    if gaussians.filter_3d is None:
        return
    scales, factors = filtered(gaussians.log_scales.double().exp(), gaussians.filter_3d.double())

    def logits(stored: Tensor) -> Tensor:
        return torch.logit(factors * stored.double().sigmoid(), eps=_EPSILON)

    others = {name: logits(gaussians.logits_in(name)) for name in gaussians.second_opacities}
    every = torch.arange(len(gaussians), device=scales.device)
    gaussians.set_opacity_logits(every, logits(gaussians.logit_opacities), others)
    gaussians.log_scales.copy_(scales.log())
    gaussians.filter_3d = None
