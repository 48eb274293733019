"""Depths of a view by a plane sweep: for each pixel the depth at which other views show what it shows.

Collins 1996, "A space-sweep approach to true multi-image matching". Depths are tried evenly in their inverse, as
disparities are. What two images differ by at a place is the difference of their brightness and of its slopes, each up
to a limit, so that what hides the place in one image does not decide. It is averaged over a small and a large window
around each pixel: the small one sees edges, the large one what flat surfaces still show.

All numbers below are open choices (benchmarks/records/thermosplat-plus-preset.md, "Swept depths").
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.training.frames.shrunk_frames import area_averages

DEPTHS = 128
"""Depths that are tried."""
NEIGHBOURS = 16
"""Other views that a view is compared with: the nearest ones."""
ALONG = 0.5
"""Least cosine of the angle between the axes of two views that are compared."""
FEWEST = 3
"""Views that must show a place."""
BRIGHTNESS = 0.05
"""Largest difference of brightness that counts [of the range]."""
SLOPES = 0.02
"""Largest difference of its slopes that counts [of the range per pixel]."""
MOST_PIXELS = 150_000
"""Larger images are shrunk for a sweep, by a whole number."""
WINDOWS = 0.0225, 0.0675
"""Sides of the two windows [of an image's width]: 9 and 27 of 400 pixels."""
_WORST = 2.0
"""Error of two views that differ in everything."""
SPAN = 0.7, 1.5
"""A sweep begins at this share of the smallest depth among the scene's points before a view, and ends at this one of
the largest. One point of a hundred at either end does not count."""


@dataclass(frozen=True, eq=False)
class SweptView:
    """A view as a sweep sees it: a pinhole camera that took its image at once.

    Args:
        viewmat: [4, 4] float32, world to camera.
        K: [3, 3] float32 intrinsics [px], of the image as it is swept.
        looks: [3, H, W] float32: brightness and its slopes to the right and down.
    """

    viewmat: Tensor
    K: Tensor
    looks: Tensor

    @classmethod
    def of(cls, view: ViewTensors) -> "SweptView":
        """That of a view with an image in [0, 1]."""
        if view.image is None:
            raise ValueError("A sweep needs images.")
        brightness = view.intensity if view.intensity is not None else view.image.mean(-1)
        factor = math.ceil(math.sqrt(view.width * view.height / MOST_PIXELS))
        height, width = view.height // factor, view.width // factor
        scale = view.K.new_tensor([[width / view.width], [height / view.height], [1.0]])
        return cls(view.viewmat, view.K * scale, _with_slopes(area_averages(brightness, width, height)))

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [px]."""
        return self.looks.shape[1], self.looks.shape[2]

    @property
    def center(self) -> Tensor:
        """The camera's centre, [3] [world units]."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def to_unit(self) -> Tensor:
        """``K`` to coordinates from -1 to 1 over the image, as ``grid_sample`` takes them, [3, 3]."""
        height, width = self.size
        return self.K.new_tensor([[2 / width, 0, -1], [0, 2 / height, -1], [0, 0, 1]]) @ self.K

    def rays(self) -> Tensor:
        """Directions through the pixels' centres with z = 1, [H, W, 3], in camera axes."""
        height, width = self.size
        ones = self.K.new_ones(height, width)
        rows, columns = torch.meshgrid(*(torch.arange(n, device=ones.device) + 0.5 for n in self.size), indexing="ij")
        return torch.stack([columns, rows, ones], dim=-1) @ torch.linalg.inv(self.K).T

    def places(self, depths: Tensor) -> Tensor:
        """Places of the scene at depths [H, W] along the rays of the pixels, [H, W, 3] [world units]."""
        return (self.rays() * depths[..., None] - self.viewmat[:3, 3]) @ self.viewmat[:3, :3]


def neighbors(view: SweptView, others: Sequence[SweptView], most: int) -> list[SweptView]:
    """The nearest of other views that look about the same way.

    Args:
        others: The others; the view itself may be among them.
        most: So many at most.
    """
    cosines = torch.stack([one.viewmat[2, :3] for one in others]) @ view.viewmat[2, :3]
    distances = torch.linalg.vector_norm(torch.stack([one.center for one in others]) - view.center, dim=-1)
    near = zip(others, cosines.tolist(), distances.tolist(), strict=True)
    along = [(distance, one) for one, cosine, distance in near if one is not view and cosine > ALONG]
    return [one for _, one in sorted(along, key=lambda pair: pair[0])][:most]


def swept_depths(view: SweptView, others: Sequence[SweptView], points: Tensor) -> Tensor:
    """z-depths [H, W] of a view [world units], 0 where fewer than ``FEWEST`` other views show what it shows.

    Args:
        others: Views of the same spectrum, of any size.
        points: The scene's sparse points, [P, 3] [world units], which say between which depths to search.
    """
    near = neighbors(view, others, NEIGHBOURS)
    before_it = points @ view.viewmat[2, :3] + view.viewmat[2, 3]
    before_it = before_it[before_it > 0]
    if len(near) < FEWEST or not len(before_it):
        return view.looks.new_zeros(view.size)
    first, last = SPAN[0] * before_it.quantile(0.01).item(), SPAN[1] * before_it.quantile(0.99).item()
    inverse = torch.linspace(1 / first, 1 / last, DEPTHS, device=points.device)
    rays, sizes = view.rays(), sorted({one.size for one in near})
    groups = [_Group.of([one for one in near if one.size == size]) for size in sizes]
    errors, known = [], []
    for one in inverse:
        places = (rays / one - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]
        sums, counts = zip(*(group.errors(places, view.looks) for group in groups), strict=True)
        total, count = torch.stack(sums).sum(0), torch.stack(counts).sum(0)
        known.append(count >= FEWEST)
        errors.append(torch.where(known[-1], total / count.clamp(min=1), _WORST))
    costs = [_averaged(torch.stack(errors), _window(share, view.size[1])) for share in WINDOWS]
    return _lowest(torch.stack(costs).sum(0), torch.stack(known), inverse)


def _lowest(costs: Tensor, known: Tensor, inverse: Tensor) -> Tensor:
    """Depths of the lowest costs [D, H, W], between those that were tried: at the vertex of a parabola through three.

    Args:
        costs: Of each depth that was tried, [D, H, W].
        known: Whether it could be tried there, [D, H, W].
        inverse: Inverse depths, [D].
    """
    best = costs.argmin(0).clamp(1, len(inverse) - 2)
    before, at, behind = (costs.gather(0, (best + step)[None])[0] for step in (-1, 0, 1))
    curvature = before + behind - 2 * at
    offset = torch.where(curvature > 1e-9, 0.5 * (before - behind) / curvature.clamp(min=1e-9), 0.0).clamp(-0.5, 0.5)
    found = 1 / (inverse[best] + offset * (inverse[1] - inverse[0]))
    return torch.where(known.gather(0, best[None])[0], found, 0.0)


@dataclass(frozen=True, eq=False)
class _Group:
    """Views of one size that another is compared with: projections to [-1, 1], [k, 3, 4], and looks, [k, 3, H, W]."""

    projections: Tensor
    looks: Tensor

    @classmethod
    def of(cls, views: Sequence[SweptView]) -> "_Group":
        """That of views."""
        projections = torch.stack([one.to_unit @ one.viewmat[:3] for one in views])
        return cls(projections, torch.stack([one.looks for one in views]))

    def errors(self, places: Tensor, looks: Tensor) -> tuple[Tensor, Tensor]:
        """How badly the views agree on places with what is seen of them: sum of errors, 0 to 2 each, and their number.

        Args:
            places: [H, W, 3] [world units].
            looks: What a view shows there, [3, H, W].
        """
        turned = torch.einsum("kij,hwj->khwi", self.projections[..., :3], places)
        seen = turned + self.projections[:, None, None, :, 3]
        at, depths = seen[..., :2] / seen[..., 2:].clamp(min=1e-6), seen[..., 2]
        shown = F.grid_sample(self.looks, at, padding_mode="border", align_corners=False)
        apart = (shown - looks).abs()
        error = apart[:, 0].clamp(max=BRIGHTNESS) / BRIGHTNESS + apart[:, 1:].mean(1).clamp(max=SLOPES) / SLOPES
        inside = (at.abs().amax(-1) < 1) & (depths > 0)
        return (error * inside).sum(0), inside.sum(0)


def _with_slopes(brightness: Tensor) -> Tensor:
    """Brightness [H, W] and its slopes to the right and down [per pixel], [3, H, W]."""
    right = F.pad((brightness[:, 2:] - brightness[:, :-2]) / 2, (1, 1))
    down = F.pad((brightness[2:] - brightness[:-2]) / 2, (0, 0, 1, 1))
    return torch.stack([brightness, right, down])


def _window(share: float, width: int) -> int:
    """An odd number of pixels."""
    return 2 * round(share * width / 2 - 0.5) + 1


def _averaged(images: Tensor, window: int) -> Tensor:
    """The mean over a square window around each pixel of [D, H, W], by rows and then by columns."""
    padded = F.pad(images[:, None], (window // 2,) * 4, mode="replicate")
    by_rows = F.avg_pool2d(padded, (1, window), stride=1)
    return F.avg_pool2d(by_rows, (window, 1), stride=1)[:, 0]
