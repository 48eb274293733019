"""Something to train on without a capture: noise seen by the camera of ``synthetic_scene``, and its Gaussians."""

from pathlib import Path
from typing import Literal

import numpy as np
import torch
from benchmark_scenes import synthetic_scene

from thermosplat.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.gaussians import Gaussians
from thermosplat.radiometry import ThermalScale

FRAMES = 2


def random_capture(width: int, height: int) -> Capture:
    """Frames of noise: RGB and pseudo-coloured thermal images of one camera and pose.

    Args:
        width: Image width [px].
        height: Image height [px].
    """
    K = synthetic_scene(1).intrinsics(width, height).tolist()
    camera = Camera(K[0][0], K[1][1], K[0][2], K[1][2], width, height)
    random = np.random.default_rng(0)
    scale = ThermalScale("color")
    palette = np.round(scale.palette.to_color(np.linspace(0, 1, 256)) * 255).astype(np.uint8)

    def view(modality: Literal["rgb", "thermal"], name: str) -> View:
        if modality == "rgb":
            image = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
        else:
            image = palette[random.integers(0, 256, (height, width))]
        return View(modality, name, Path(f"{name}.png"), camera, np.eye(4), image)

    frames = tuple(Frame(name, view("rgb", name), view("thermal", name)) for name in map(str, range(FRAMES)))
    points = random.uniform(1, 2, (16, 3)).astype(np.float32)
    colors = random.integers(0, 256, (16, 3), dtype=np.uint8)
    return Capture("random", Path("random"), "colmap", frames, (), points, colors, scale)


def random_gaussians(count: int, *, feature_dim: int, sh_degree: int) -> Gaussians:
    """The Gaussians of ``synthetic_scene`` as a set that two spectra share.

    Args:
        count: Their number; the smaller they are the more there are, so that pairs a tile grow less than it.
        feature_dim: Latent channels, at least 1.
        sh_degree: Highest degree of the spherical harmonics.
    """
    scene = synthetic_scene(count)
    logits, thermal_logits = (torch.logit(values, eps=1e-6) for values in (scene.opacities, scene.thermal_opacities))
    return Gaussians(
        {
            "means": scene.means,
            "quats": scene.quats,
            "log_scales": scene.scales.log(),
            "logit_opacities": logits,
            "thermal_opacity_offsets": thermal_logits - logits,
            "logit_thermal_opacities": thermal_logits,
            "sh0": scene.sh[:, :1],
            "shN": scene.sh[:, 1 : (sh_degree + 1) ** 2],
            "features": scene.features(feature_dim),
        }
    )
