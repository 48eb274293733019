"""The Gaussians that some views see, fetched from a set of which most lies in the host's memory."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from thermosplat.fused.row_fetch import fetched_rows
from thermosplat.rasterizer import project
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.offloaded import OffloadedParameter, some_offloaded
from thermosplat.scene.packed_parameters import is_band
from thermosplat.scene.pixel_filter import PixelFilter
from thermosplat.scene.views import projection_arguments

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors

_PROJECTED_AT_ONCE = 2**22
"""Gaussians whose projections are held while it is found out which are in view: 0.4 GB. Open choice."""


class GaussiansInView(Gaussians):
    """The n of N Gaussians that views may see, in their order; rendering these alone gives the same images.

    Gradients of what lies on the device go to the set's own parameters. Of what is offloaded, copied rows get them.

    Attributes:
        indices: Which Gaussians of the set these are, int64, ascending, shape [n].
        rows: By name of the offloaded parameter its rows, shape [n, ...], leaves of autograd. Of spherical harmonics
            only the coefficients in use.

    Args:
        gaussians: The set.
        indices: Which.
        sh_degree: Highest degree of the spherical harmonics in use.
    """

    def __init__(self, gaussians: Gaussians, indices: Tensor, sh_degree: int) -> None:
        nn.Module.__init__(self)
        self.indices = indices
        self.rows: dict[str, Tensor] = {}
        self.register_buffer("feature_basis", gaussians.feature_basis)
        self.second_opacities = gaussians.second_opacities
        for name, parameter in gaussians.named_parameters():
            if isinstance(parameter, OffloadedParameter):
                rows = fetched_rows(parameter, indices, (sh_degree + 1) ** 2 - 1 if is_band(name) else None)
                self.rows[name] = rows.requires_grad_(parameter.requires_grad and torch.is_grad_enabled())
                value = rows
            else:
                value = torch.index_select(parameter, 0, indices)
            object.__setattr__(self, name, value)


def gaussians_in_view(
    gaussians: Gaussians,
    views: Sequence["ViewTensors"],
    sh_degree: int,
    pixel_filter: PixelFilter,
) -> Gaussians:
    """What there is to render for some views: the set, or where some of it is offloaded, its Gaussians in view.

    Args:
        gaussians: The set.
        views: The cameras; none: the set is not rendered.
        sh_degree: Highest degree of the spherical harmonics in use.
        pixel_filter: How footprints are widened.
    """
    if not views or not some_offloaded(gaussians):
        return gaussians
    return GaussiansInView(gaussians, indices_in_view(gaussians, views, pixel_filter), sh_degree)


@torch.no_grad()
def indices_in_view(gaussians: Gaussians, views: Sequence["ViewTensors"], pixel_filter: PixelFilter) -> Tensor:
    """Gaussians that the renderer draws for one of the views at least, in some spectrum; int64, ascending, [n].

    Args:
        gaussians: The set.
        views: The cameras.
        pixel_filter: How footprints are widened.
    """
    seen = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    opacities = gaussians.largest_opacities
    for first in range(0, len(gaussians), _PROJECTED_AT_ONCE):
        part = slice(first, first + _PROJECTED_AT_ONCE)
        of_part = gaussians.means[part], gaussians.quats[part], torch.exp(gaussians.log_scales[part]), opacities[part]
        for view in views:
            camera = projection_arguments(view)
            scene = project(*of_part, eps2d=pixel_filter.eps2d, **camera)
            seen[part] |= scene.projected.visible.reshape(-1)
    return torch.where(seen)[0]
