"""What a model shows of one spectrum, and what splats show in its place."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.scene import Colors, shown_colors
from thermosplat.export.splat_rendering import render_splats
from thermosplat.export.splats import Splats
from thermosplat.image_quality.metrics import psnr
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.radiometry import PixelScale

_EXACT_PSNR = 100.0


class ExactImages:
    """Images of a model and of splats that are comparable: the same camera, colours and background."""

    @torch.no_grad()
    def __init__(self, model: SceneModel, name: str, scale: PixelScale, sh_degree: int, colors: Colors) -> None:
        self.model, self.name, self.scale, self.sh_degree, self.colors = model, name, scale, sh_degree, colors
        empty = model.formations[name].behind(model.background)
        self.background = shown_colors(empty[None, None].clamp(0, 1), scale, colors)[0, 0]
        """What the model shows where there are no Gaussians, [3]; splats shall not take it up."""

    @torch.no_grad()
    def image(self, view: ViewTensors) -> Tensor:
        """The exact image by a pinhole camera, colours [H, W, 3] in [0, 1]."""
        pinhole = view.as_pinhole()
        rendered = self.model.render({self.name: pinhole}, sh_degree=self.sh_degree, shared_cameras=[[self.name]])
        exact = rendered.images[self.name].clamp(0, 1)
        return shown_colors(exact, self.scale, self.colors)

    def render(self, splats: Splats, view: ViewTensors) -> Tensor:
        """The splats' image as other viewers show it, [H, W, 3], not clamped from above."""
        return render_splats(splats, view, background=self.background)

    @torch.no_grad()
    def mean_psnr(self, splats: Splats, views: Sequence[ViewTensors]) -> float:
        """PSNR of the splats against the exact images [dB], the mean over the views; 100 where nothing differs."""
        total = sum(min(psnr(self.render(splats, view), self.image(view)), _EXACT_PSNR) for view in views)
        return total / len(views) if views else math.nan
