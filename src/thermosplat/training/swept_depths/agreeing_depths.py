"""Depths that several views agree on, from depths that each found alone.

Where images show little, each view errs by chance. The median of what many views say of a place is far more exact, as
in the fusion of depth maps by consistency (Merrell et al. 2007, "Real-time visibility-based fusion of depth maps"), and
so is the mean over pixels of one surface. Means are of inverse depths, which are linear in the image where a surface is
flat.

All numbers below are open choices (benchmarks/records/thermosplat-plus-preset.md, "Swept depths").
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from thermosplat.training.swept_depths.plane_sweep import SweptView, neighbors

NEIGHBOURS = 30
"""Views that are asked about a view's depths: the nearest ones."""
ALIKE = 0.03
"""Largest difference of the logarithms of two depths that are of one surface."""
FEWEST = 3
"""Views that must agree, at least ..."""
AGREEING = 0.6
"""... and this share of those in whose images a place lies."""
SMOOTHED = 0.005
"""Pixels on each side over which depths are averaged [of an image's width]: 2 of 400."""
ROUNDS = 8
"""Times that all views take the median and average it."""


def agreed_depths(views: Sequence[SweptView], depths: Sequence[Tensor]) -> list[Tensor]:
    """Depths of views after all rounds, [H, W] each, 0 where too few agree.

    Args:
        depths: Their z-depths, [H, W] each [world units], 0 where unknown.
    """
    place = {id(one): i for i, one in enumerate(views)}
    asked = [[place[id(one)] for one in neighbors(view, views, NEIGHBOURS)] for view in views]
    for _ in range(ROUNDS):
        depths = [_smoothed(_median(views, depths, i, asked[i])) for i in range(len(views))]
    return list(depths)


def _median(views: Sequence[SweptView], depths: Sequence[Tensor], i: int, asked: Sequence[int]) -> Tensor:
    """Depths of a view: the median of its own and of those that others say, where they are alike."""
    own, view = depths[i], views[i]
    places = view.places(own)
    said, seen = [torch.where(own > 0, own, torch.nan)[None]], torch.zeros_like(own)
    for size in sorted({views[j].size for j in asked}):
        some = [j for j in asked if views[j].size == size]
        theirs, inside = _said_by([views[j] for j in some], torch.stack([depths[j] for j in some]), places)
        # what the others see there, as far away as this view sees it
        back = theirs @ view.viewmat[2, :3] + view.viewmat[2, 3]
        alike = inside & ((back / own).log().abs() < ALIKE)  # never where one of them is unknown
        said.append(torch.where(alike, back, torch.nan))
        seen = seen + inside.sum(0)
    stacked = torch.cat(said)
    enough = (~stacked[1:].isnan()).sum(0) >= (AGREEING * seen).clamp(min=FEWEST)
    return torch.where(enough & (own > 0), stacked.nanmedian(0).values, 0.0)


def _said_by(views: Sequence[SweptView], depths: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Where views of one size have their surfaces in the direction of places.

    Args:
        depths: Their z-depths, [k, H, W]; 0 where unknown.
        places: [h, w, 3] [world units].

    Returns:
        Places [k, h, w, 3], NaN where unknown, and whether the places asked for lie in their images, [k, h, w].
    """
    viewmats, to_units = torch.stack([one.viewmat for one in views]), torch.stack([one.to_unit for one in views])
    turns, moves = viewmats[:, None, None, :3, :3], viewmats[:, None, None, :3, 3]
    in_camera = (turns @ places[..., None])[..., 0] + moves
    rays = in_camera / in_camera[..., 2:].clamp(min=1e-6)
    at = (to_units[:, None, None] @ rays[..., None])[..., :2, 0]
    inside = (at.abs().amax(-1) < 1) & (in_camera[..., 2] > 0)
    theirs = F.grid_sample(depths[:, None], at, mode="nearest", align_corners=False)[:, 0]
    there = rays * torch.where(theirs > 0, theirs, torch.nan)[..., None] - moves
    return (turns.transpose(-1, -2) @ there[..., None])[..., 0], inside


def _smoothed(depths: Tensor) -> Tensor:
    """Each inverse depth [H, W] as the mean over a square around it, of opposite pixels that are both alike."""
    height, width = depths.shape
    inverse = torch.where(depths > 0, 1 / depths, 0.0)
    reach = max(1, round(SMOOTHED * width))
    padded = F.pad(inverse[None, None], (reach,) * 4)[0, 0]
    total, count = torch.zeros_like(inverse), torch.zeros_like(inverse)

    def shifted(down: int, right: int) -> Tensor:
        return padded[reach + down : reach + down + height, reach + right : reach + right + width]

    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            one, opposite = shifted(down, right), shifted(-down, -right)
            # pixels that are unknown are 0, which nothing is like
            alike = ((one - inverse).abs() < ALIKE * inverse) & ((opposite - inverse).abs() < ALIKE * inverse)
            total, count = total + one * alike, count + alike
    return torch.where(depths > 0, count / total.clamp(min=1e-30), 0.0)
