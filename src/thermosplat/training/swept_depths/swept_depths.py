"""Depths of all training views by plane sweeps, which depths of the scene are drawn to.

Images that show little say little about depth: Gaussians of one colour do as well before a surface as behind it. A
sweep asks one view after the other at which depth the images agree, and what many views agree on is exact.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.losses.image_terms import swept_depth_loss
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import label
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.swept_depths.agreeing_depths import agreed_depths
from thermosplat.training.swept_depths.plane_sweep import FEWEST, SweptView, swept_depths

Size = tuple[int, int]
MOST_POINTS = 100_000
"""Of more points, evenly chosen ones say between which depths to search."""
AGREED = 0.05
"""Share of their pixels in which views must agree on depths, or none of them is used: what a few agree on by chance is
wrong. Open choice: thermal images of lab and yard agree in 0.6 and 0.7 of their pixels, those of desk, arco and room in
less than 0.005 (benchmarks/records/real-captures.md)."""

LIMIT = 0.03
"""Largest difference of log z from a swept depth that counts. Where it is larger the sweep found another surface, or is
wrong. Open choice."""


class SweptDepths:
    """Depths of the training views, by spectrum.

    Args:
        found: By spectrum and height and width of the images [px], log z of views, [n, H, W], NaN where unknown.
        rows: By the same, the place of each training frame among these views, [F] int64; -1 of others.
    """

    def __init__(
        self,
        weights: Mapping[str, float],
        found: Mapping[tuple[str, Size], Tensor],
        rows: Mapping[tuple[str, Size], Tensor],
    ) -> None:
        self._weights, self._found, self._rows = weights, found, rows

    def __bool__(self) -> bool:
        """Whether any view was swept."""
        return bool(self._found)

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        frames: TrainFrames,
        config: TrainConfig,
        points: Tensor,
        say: Callable[[str], object],
        all_can: Callable[[bool], bool] = bool,
    ) -> Self:
        """Sweep the training images of the spectra that ask for it (``SpectrumConfig.swept_depth``).

        Views with a lens or whose lines are read one after the other are left out. So are all while cameras are
        corrected, where images are read from the disk, or where the device has no room for depths.

        Args:
            frames: The training frames.
            points: The scene's sparse points, [P, 3] [world units].
            say: Tells the user what is done and found, or why nothing is.
            all_can: Whether all processes of the training can, asked by each that can or cannot: none sweeps alone.
        """
        weights = {name: one.swept_depth for name, one in config.modelled.items() if one.swept_depth > 0}
        found: dict[tuple[str, Size], Tensor] = {}
        rows: dict[tuple[str, Size], Tensor] = {}
        for name in weights:
            views = _plain_views(frames, name)
            why_not = _why_not(frames, config, views)
            if not all_can(why_not is None):
                reason = why_not or "another device has no memory left for them"
                say(f"Depths of {label(name)} images are not swept: {reason}.")
                continue
            say(f"Sweeping {len(views)} {label(name)} images for depths.")
            depths = depths_of_views(list(views.values()), points)
            pairs = zip(views.items(), depths, strict=True)
            known = {i: _enlarged(depth, view).log() for (i, view), depth in pairs}  # [H, W], NaN where unknown
            share = torch.cat([~depth.isnan().flatten() for depth in known.values()]).float().mean().item()
            if share < AGREED:
                say(f"They agree on depths in {share:.0%} of their pixels, too few: no depths are used.")
                continue
            for size in {depth.shape for depth in known.values()}:
                some = [i for i, depth in known.items() if depth.shape == size]
                key = name, (size[0], size[1])
                found[key] = torch.stack([known[i] for i in some])
                rows[key] = torch.full((len(frames),), -1, device=frames.device)
                rows[key][some] = torch.arange(len(some), device=frames.device)
            say(f"They agree on depths in {share:.0%} of their pixels.")
        return cls(weights, found, rows)

    def losses(self, rendered: RenderedFrame, index: Tensor) -> dict[str, Tensor]:
        """Weighted loss terms of one training frame at full size.

        Args:
            rendered: The render, with blended log-depths.
            index: Its place among the training frames, int64 scalar on the device.
        """
        terms = {}
        for name, log_depth in rendered.log_depths.items():
            key = name, (log_depth.shape[0], log_depth.shape[1])
            if key not in self._found:
                continue
            row = self._rows[key].index_select(0, index.reshape(1))
            target = torch.where(row[:, None] < 0, torch.nan, self._found[key].index_select(0, row.clamp(min=0))[0])
            loss = swept_depth_loss(log_depth, rendered.alphas[name], target, LIMIT)
            terms[f"{name}_swept_depth"] = self._weights[name] * loss
        return terms


def depths_of_views(views: Sequence[ViewTensors], points: Tensor) -> list[Tensor]:
    """z-depths that views of one spectrum agree on, [H, W] each [world units], 0 where unknown.

    Args:
        views: The views, of pinhole cameras, with images in [0, 1]. Large ones have smaller depths (``SweptView.of``).
        points: The scene's sparse points, [P, 3] [world units].
    """
    swept = [SweptView.of(view) for view in views]
    some = points[:: math.ceil(max(len(points), 1) / MOST_POINTS)].to(swept[0].viewmat.device)
    return agreed_depths(swept, [swept_depths(one, swept, some) for one in swept])


def _plain_views(frames: TrainFrames, name: str) -> dict[int, ViewTensors]:
    """A spectrum's training views that a pinhole camera took at once, by their frame's index."""
    if frames.from_disk is not None:
        return {}
    views = {i: frames[i].views[name] for i, frame in enumerate(frames.frames) if name in frame.views}
    return {
        i: view
        for i, view in views.items()
        if view.image is not None and view.lens is None and view.distortion is None and view.readout is None
    }


def _why_not(frames: TrainFrames, config: TrainConfig, views: Mapping[int, ViewTensors]) -> str | None:
    """What keeps views from being swept; None: nothing, and room for their depths is taken."""
    if config.refine:
        return "cameras are corrected while training"
    if frames.from_disk is not None:
        return "images are read from the disk while training"
    if len(views) <= FEWEST:
        return f"more than {FEWEST} views of pinhole cameras are needed, found {len(views)}"
    if not frames.reserve(4 * sum(view.width * view.height for view in views.values())):
        return "there is no memory left for them"
    return None


def _enlarged(depth: Tensor, view: ViewTensors) -> Tensor:
    """A depth for each pixel of the view, NaN where unknown or masked, of depths of a smaller image."""
    known = torch.where(depth > 0, depth, torch.nan)
    enlarged = F.interpolate(known[None, None], (view.height, view.width), mode="nearest")[0, 0]
    return enlarged if view.mask is None else enlarged.where(view.mask, torch.nan)
