"""Depths that several views agree on, from depths that each found alone.

Where images show little, each view errs by chance. The median of what many views say of a place is far more exact, as
in the fusion of depth maps by consistency (Merrell et al. 2007, "Real-time visibility-based fusion of depth maps").
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
"""Views that must agree."""
ROUNDS = 8
"""Times that all views take the median; each moves what little images show further from chance."""


def agreed_depths(views: Sequence[SweptView], depths: Sequence[Tensor]) -> list[Tensor]:
    """Depths of views after all rounds, [H, W] each, 0 where too few agree.

    Args:
        views: The views.
        depths: Their z-depths, [H, W] each [world units], 0 where unknown.
    """
    near = [_places_in(view, views) for view in views]
    for _ in range(ROUNDS):
        depths = [_median(views, depths, i, near[i]) for i in range(len(views))]
    return list(depths)


def _places_in(view: SweptView, views: Sequence[SweptView]) -> list[int]:
    place = {id(one): i for i, one in enumerate(views)}
    return [place[id(one)] for one in neighbors(view, views, NEIGHBOURS)]


def _median(views: Sequence[SweptView], depths: Sequence[Tensor], i: int, near: Sequence[int]) -> Tensor:
    """Depths of a view: the median of its own and of those that others say, where they are alike."""
    own = depths[i]
    places = views[i].places(own)
    said = [torch.where(own > 0, own, torch.nan)]
    for j in near:
        at, z = views[j].seen(places)
        theirs = F.grid_sample(depths[j][None, None], at[None], mode="nearest", align_corners=False)[0, 0]
        # what the other view sees there, carried back
        pixels = torch.cat([(at + 1) / 2 * at.new_tensor(views[j].size[::-1]), torch.ones_like(at[..., :1])], dim=-1)
        in_camera = pixels @ torch.linalg.inv(views[j].K).T * theirs[..., None]
        back = (in_camera - views[j].viewmat[:3, 3]) @ views[j].viewmat[:3, :3]
        back = back @ views[i].viewmat[2, :3] + views[i].viewmat[2, 3]
        alike = (theirs > 0) & (z > 0) & (back > 0) & ((back / own).log().abs() < ALIKE)
        said.append(torch.where(alike, back, torch.nan))
    stacked = torch.stack(said)
    enough = (~stacked[1:].isnan()).sum(0) >= FEWEST
    return torch.where(enough & (own > 0), stacked.nanmedian(0).values, 0.0)
