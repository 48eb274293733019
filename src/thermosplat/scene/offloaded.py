"""Parameters of Gaussians that lie in the host's memory, or whose moments do: ``--offload``.

Of a Gaussian's 68 numbers 53 are spherical harmonics above degree 0 and latent features. To find out which Gaussians a
camera sees takes none of them. So they and what Adam keeps of them may lie in the host's memory, from where a step
fetches the rows of the Gaussians in view and where it updates them (``fused.row_adam``). The
idea is CLM's (Zhao et al. 2025, arXiv 2511.04951).
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from thermosplat.fused.row_fetch import fetched_rows
from thermosplat.rasterizer import project
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.packed_parameters import is_band
from thermosplat.scene.pixel_filter import PixelFilter
from thermosplat.scene.views import projection_arguments
from thermosplat.torch_bridge.host_rows import has_padded_rows, in_host_rows, on_cpu

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


class OffloadedParameter(nn.Parameter):
    """A parameter [N, ...] whose moments lie in the host's memory, and with ``on_host`` its numbers, too.

    It says that it is on the device, whose kernels reach the host's memory over the bus. It never has a gradient of its
    own shape.
    """

    on_host: bool = False

    @classmethod
    def of(
        cls, values: Tensor, device: torch.device | str, *, on_host: bool, requires_grad: bool = True
    ) -> "OffloadedParameter":
        """A parameter of these values, which are copied unless they lie where they shall.

        Args:
            values: float32, anywhere.
        """
        values = values.detach()
        made = cls(in_host_rows(values, device) if on_host else values.to(device), requires_grad)
        made.on_host = on_host
        return made

    @torch.no_grad()
    def go_to_host(self) -> None:
        """Have the numbers in the host's memory for a while, wherever they belong."""
        self.data = in_host_rows(self.data, self.device)

    @torch.no_grad()
    def come_back(self) -> None:
        """Have them on the device again where they belong there; where it has no room they stay, and all works on."""
        if not self.on_host and has_padded_rows(self.data):
            with suppress(torch.OutOfMemoryError):
                self.data = self.data.clone(memory_format=torch.contiguous_format)


def can_be_offloaded(name: str, parameter: Tensor) -> bool:
    """Whether a parameter has long rows that only Gaussians in view need.

    Args:
        parameter: Its values, [N, ...].
    """
    return (name == "features" or is_band(name)) and parameter.numel() > 0


def offload(gaussians: Gaussians, device: torch.device, *, parameters: bool) -> None:
    """Have what can be offloaded trained in the host's memory; the rest stays as it is.

    Args:
        gaussians: A set of Gaussians, that no optimizer knows yet.
        parameters: Move the parameters themselves, too; else their moments alone will lie there.
    """
    for name, parameter in list(gaussians.named_parameters()):
        if can_be_offloaded(name, parameter):
            moved = OffloadedParameter.of(parameter, device, on_host=parameters, requires_grad=parameter.requires_grad)
            setattr(gaussians, name, moved)


def stored_values(gaussians: nn.Module) -> dict[str, Tensor]:
    """A set's state as checkpoints take it. What is offloaded is copied to tensors of the CPU, so that packing it takes
    none of the device's memory.
    """
    on_host = {name for name, value in gaussians.named_parameters() if isinstance(value, OffloadedParameter)}
    return {name: on_cpu(value) if name in on_host else value for name, value in gaussians.state_dict().items()}


PROJECTED_AT_ONCE = 2**22
"""Gaussians whose projections are held while it is found out which are in view: 0.4 GB. Open choice."""


class GaussiansInView(Gaussians):
    """The n of N Gaussians that views may see, in their order; rendering these alone gives the same images.

    Gradients of what lies on the device go to the set's own parameters. Of what is offloaded, copied rows get them.

    Attributes:
        indices: Which Gaussians of the set these are, int64, ascending, shape [n].
        rows: By name of the offloaded parameter its rows, shape [n, ...], leaves of autograd. Of spherical harmonics
            only the coefficients in use.

    Args:
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
    gaussians: Gaussians, views: Sequence["ViewTensors"], sh_degree: int, pixel_filter: PixelFilter
) -> GaussiansInView:
    """What there is to render of a set for some cameras. Other arguments are those of ``GaussiansInView``."""
    return GaussiansInView(gaussians, indices_in_view(gaussians, views, pixel_filter), sh_degree)


@torch.no_grad()
def indices_in_view(gaussians: Gaussians, views: Sequence["ViewTensors"], pixel_filter: PixelFilter) -> Tensor:
    """Gaussians that the renderer draws for one of the views at least, in some spectrum; int64, ascending, [n]."""
    seen = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    opacities = gaussians.largest_opacities
    for first in range(0, len(gaussians), PROJECTED_AT_ONCE):
        part = slice(first, first + PROJECTED_AT_ONCE)
        of_part = gaussians.means[part], gaussians.quats[part], torch.exp(gaussians.log_scales[part]), opacities[part]
        for view in views:
            camera = projection_arguments(view)
            scene = project(*of_part, eps2d=pixel_filter.eps2d, **camera)
            seen[part] |= scene.projected.visible.reshape(-1)
    return torch.where(seen)[0]
