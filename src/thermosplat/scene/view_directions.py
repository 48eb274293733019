"""The direction in which each pixel of a view looks."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from thermosplat.scene.lens_slopes import straightened

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors


def view_directions(view: "ViewTensors") -> Tensor:
    """Unit vectors from the camera through the pixel centres, in world coordinates, at the time of each line.

    Returns:
        Directions, shape [H, W, 3].
    """
    if view.orthographic:
        return view.viewmat[2, :3].expand(view.height, view.width, 3)
    device = view.K.device
    x = (torch.arange(view.width, device=device) + 0.5 - view.K[0, 2]) / view.K[0, 0]
    y = (torch.arange(view.height, device=device) + 0.5 - view.K[1, 2]) / view.K[1, 1]
    if view.lens is not None:
        grid = torch.stack([x.expand(view.height, -1), y[:, None].expand(-1, view.width)], dim=-1)
        slopes = straightened(grid, view)
        in_camera = torch.cat([slopes, torch.ones_like(slopes[..., :1])], dim=-1)
    else:
        in_camera = torch.stack(
            [x.expand(view.height, -1), y[:, None].expand(-1, view.width), torch.ones_like(x).expand(view.height, -1)],
            dim=-1,
        )
    if view.readout is None:
        return torch.nn.functional.normalize(in_camera @ view.viewmat[:3, :3], dim=-1)  # R^T d, as row vectors
    first, last = (view.readout @ view.viewmat)[:, :3, :3]
    # the chord in place of the arc between both directions: a turn of 5 degrees differs by 0.05 degrees half way
    return torch.nn.functional.normalize(torch.lerp(in_camera @ first, in_camera @ last, line_times(view)), dim=-1)


def line_times(view: "ViewTensors") -> Tensor:
    """When each line of a view is read, from 0 to 1; shape [H, 1, 1], or [1, W, 1] where lines are columns."""
    across = view.line_order in ("left-to-right", "right-to-left")
    times = torch.linspace(0.0, 1.0, view.width if across else view.height, device=view.K.device)
    if view.line_order in ("bottom-to-top", "right-to-left"):
        times = times.flip(0)
    return times[None, :, None] if across else times[:, None, None]
