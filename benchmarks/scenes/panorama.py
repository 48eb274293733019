"""Random Gaussians all around cameras in one place, each of which sees a given share of them."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.thermal.radiometry import GREY, PixelScale

FRAMES = 8
NEAREST, FARTHEST = 2.0, 10.0


def focal_length(share: float, width: int, height: int) -> float:
    """Focal length [px] of a camera that looks at a share of all directions.

    A rectangle of half-widths tan a and tan b at distance 1 fills the solid angle 4 asin(sin a sin b).

    Args:
        share: Between 0 and 1/6.
        width: Of the image [px].
        height: Of the image [px].
    """
    shortest, longest = 1e-3 * width, 1e3 * width
    for _ in range(60):
        focal = math.sqrt(shortest * longest)
        halves = [math.sin(math.atan(side / 2 / focal)) for side in (width, height)]
        if 4.0 * math.asin(halves[0] * halves[1]) / (4.0 * math.pi) > share:
            shortest = focal
        else:
            longest = focal
    return focal


def panorama_capture(share: float, width: int, height: int) -> Capture:
    """Frames of noise in two spectra from one place, turned by equal angles.

    Args:
        share: Of all directions that a frame sees.
        width: Of the images [px].
        height: Of the images [px].
    """
    random, focal = np.random.default_rng(0), focal_length(share, width, height)
    camera = Camera(focal, focal, width / 2, height / 2, width, height)

    def frame(number: int) -> Frame:
        yaw, pitch = 2.0 * math.pi * number / FRAMES, 0.4 * (-1) ** number
        around_y = [[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]]
        around_x = [[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]]
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.array(around_x) @ np.array(around_y)
        image = random.integers(0, 256, (height, width, 3), dtype=np.uint8)
        heat = random.random((height, width, 1), dtype=np.float32)
        name = f"frame{number}"
        views = {
            "rgb": View("rgb", name, Path(f"{name}.png"), camera, viewmat, image),
            "thermal": View("thermal", name, Path(f"{name}_t.png"), camera, viewmat, heat),
        }
        return Frame(name, views)

    return Capture(
        name="panorama",
        root=Path("panorama"),
        layout="noise",
        train=tuple(map(frame, range(FRAMES))),
        test=(),
        points=random.uniform(-1, 1, (100, 3)).astype(np.float32),
        point_colors=random.integers(0, 256, (100, 3), dtype=np.uint8),
        scales={"rgb": PixelScale("photograph"), "thermal": PixelScale("scalar", GREY, (0.0, 1.0), "celsius")},
    )


def panorama_values(
    name: str, count: int, shape: Iterable[int], share: float, device: torch.device, seed: int
) -> Tensor:
    """Values of a parameter of these Gaussians, [count, *shape].

    Their size in the image is that of as many random Gaussians as fill it with an overdraw of about 70, whatever the
    count, as in ``benchmark_scenes.synthetic_scene``.

    Args:
        name: The parameter.
        count: Gaussians all around.
        shape: Extents behind the first.
        share: Of them that a camera sees.
        device: Where.
        seed: Of the random numbers; the same for all parameters of a scene.
    """
    draw = torch.Generator(device).manual_seed(seed)
    directions = torch.randn(count, 3, generator=draw, device=device)
    distances = NEAREST + (FARTHEST - NEAREST) * torch.rand(count, 1, generator=draw, device=device)
    if name == "means":
        return distances * torch.nn.functional.normalize(directions, dim=-1)
    if name == "log_scales":
        size = 0.0065 * math.sqrt(20_000 / max(share * count, 1.0)) * distances
        return size.log() + 0.5 * torch.randn(count, 3, generator=draw, device=device)
    draw.manual_seed(seed + sum(map(ord, name)))
    return torch.randn(count, *shape, generator=draw, device=device) * (0.1 if name == "shN" else 1.0)
