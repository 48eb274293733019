"""Splats rendered as a third-party viewer would: spherical harmonics alone, at one opacity, by our rasterizer."""

import torch
from torch import Tensor

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splats import Splats
from thermosplat.rasterizer import rasterization
from thermosplat.scene.pixel_filter import PixelFilter

OTHERS = PixelFilter()
"""What most other viewers do with a footprint, whatever the scene was trained with."""


def render_splats(splats: Splats, view: ViewTensors, *, background: Tensor | None = None) -> Tensor:
    """An image of splats by a pinhole camera.

    Args:
        splats: The Gaussians; gradients flow into all of them.
        view: Camera and pose; a distortion of its lens is left out.
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
        **OTHERS._asdict(),
        backgrounds=None if background is None else background[None],
    )
    return image.squeeze(0)
