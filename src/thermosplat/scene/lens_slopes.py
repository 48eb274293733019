"""Where a view's lens lets points be seen, and where its pixels look, for what reads pixels beside the renderer.

Slopes are x / z and y / z in camera axes; bent slopes times focal lengths, plus the principal point, are pixels. The
formulas are those of docs/conventions.md.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from thermosplat.datasets.frame_tensors import ViewTensors

ITERATIONS = 40
"""Of the inverse, of which a few are enough for a weak lens. A fisheye's is Newton's method."""


def bent(slopes: Tensor, view: "ViewTensors") -> Tensor:
    """Slopes as a view's lens bends them; without a lens they stay.

    Args:
        slopes: Shape [..., 2].

    Returns:
        Shape [..., 2].
    """
    return slopes if view.lens is None else BENDS[view.lens_model](slopes, view.lens)


def straightened(slopes: Tensor, view: "ViewTensors") -> Tensor:
    """The inverse of ``bent``; not differentiable.

    Args:
        slopes: Bent slopes, shape [..., 2].

    Returns:
        Shape [..., 2].
    """
    if view.lens is None:
        return slopes
    with torch.no_grad():
        if view.lens_model == "fisheye":
            return _straightened_fisheye(slopes, view.lens)
        found = slopes
        for _ in range(ITERATIONS):
            x, y = found.unbind(dim=-1)
            far = (x * x + y * y).clamp(min=1e-20)[..., None]
            image = bent(found, view)
            # the radial factor at this place, which tangential terms hardly change
            factor = (image * found).sum(dim=-1, keepdim=True) / far
            found = found + (slopes - image) / torch.where(far > 1e-12, factor, torch.ones_like(factor)).clamp(min=0.1)
    return found


def _rational(slopes: Tensor, lens: Tensor) -> Tensor:
    k1, k2, k3, k4, k5, k6, p1, p2 = lens
    x, y = slopes.unbind(dim=-1)
    square = x * x + y * y
    c = (1 + square * (k1 + square * (k2 + square * k3))) / (1 + square * (k4 + square * (k5 + square * k6)))
    across = c * x + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    down = c * y + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return torch.stack([across, down], dim=-1)


def _fisheye(slopes: Tensor, lens: Tensor) -> Tensor:
    k1, k2, k3, k4 = lens[:4]
    x, y = slopes.unbind(dim=-1)
    radius = (x * x + y * y).clamp(min=1e-20).sqrt()
    theta = torch.atan(radius)
    t = theta * theta
    share = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) / radius
    return slopes * share[..., None]


BENDS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"pinhole": _rational, "fisheye": _fisheye}
"""By ``ViewTensors.lens_model``: of slopes [..., 2] and k1 to k6, p1 and p2, [8]."""


def _straightened_fisheye(slopes: Tensor, lens: Tensor) -> Tensor:
    length = slopes.norm(dim=-1, keepdim=True).clamp(min=1e-10)
    k1, k2, k3, k4 = lens[:4]
    theta = length
    for _ in range(ITERATIONS):
        t = theta * theta
        value = theta * (1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) - length
        rise = 1 + t * (3 * k1 + t * (5 * k2 + t * (7 * k3 + t * 9 * k4)))
        theta = (theta - value / rise.clamp(min=0.1)).clamp(0.0, 1.57)
    return slopes * torch.tan(theta) / length
