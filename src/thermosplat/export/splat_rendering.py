"""Splats rendered as a third-party viewer would: spherical harmonics alone, at one opacity, by our rasterizer."""

from typing import Literal

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splats import Splats
from thermosplat.rasterizer import rasterization

RasterizeMode = Literal["classic", "antialiased"]


def render_splats(
    splats: Splats, view: ViewTensors, *, rasterize_mode: RasterizeMode = "classic", background: Tensor | None = None
) -> Tensor:
    """An image of splats by a pinhole camera.

    Args:
        splats: The Gaussians; gradients flow into all of them.
        view: Camera and pose; a distortion of its lens is left out.
        rasterize_mode: As the rasterizer's.
        background: Colour behind them, [3]; None: black.

    Returns:
        Colours [H, W, 3], not clamped from above.
    """
    degree = int((splats.shN.shape[1] + 1) ** 0.5) - 1
    image, _, _ = rasterization(
        splats.means,
        splats.quats,
        torch.exp(splats.log_scales),
        torch.sigmoid(splats.logit_opacities),
        (splats.sh0, splats.shN),
        view.viewmat[None],
        view.K[None],
        view.width,
        view.height,
        sh_degree=degree,
        packed=False,
        rasterize_mode=rasterize_mode,
        backgrounds=None if background is None else background[None],
    )
    return image.squeeze(0)
