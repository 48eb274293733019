"""A capture of any number of images, most of which are copies: links to the files of a few."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from thermosplat.datasets.capture import Capture

DISTORTION = {"k1": -0.08, "k2": 0.01, "p1": 0.0, "p2": 0.0}
"""Of the lens that the copies are said to have, so that each has to be undistorted."""
NOISE = 4.0
"""Standard deviation of the noise on enlarged images [8-bit levels]: without it they take less time to decode than
photographs of their size."""


def capture_of_copies(folder: Path, source: Capture, pairs: int, size: tuple[int, int], distinct: int) -> Path:
    """Write a capture in nerfstudio's layout.

    Args:
        folder: Where; it is made.
        source: A capture of RGB and thermal images, whose frames are enlarged.
        pairs: Pairs of images.
        size: Width and height of each [px].
        distinct: Pairs that are encoded; all others are links to them.

    Returns:
        The folder.
    """
    frames = [frame for frame in source.train if {"rgb", "thermal"} <= frame.views.keys()][:distinct]
    folders = {"rgb": "images", "thermal": "thermal"}
    for name in folders.values():
        (folder / name).mkdir(parents=True, exist_ok=True)
    entries: list[dict[str, Any]] = []
    for number in range(pairs):
        first, frame = number % len(frames), frames[number % len(frames)]
        for spectrum, name in folders.items():
            file = folder / name / f"frame_{number:06d}.jpg"
            if number < len(frames):
                cv2.imwrite(str(file), _enlarged(frame.views[spectrum].pixels().image, size, seed=number))
            else:
                os.link(folder / name / f"frame_{first:06d}.jpg", file)
        pose = np.linalg.inv(frame.views["rgb"].viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes
        entries.append({"file_path": f"images/frame_{number:06d}.jpg", "transform_matrix": pose.tolist()})
        entries[-1]["thermal_file_path"] = f"thermal/frame_{number:06d}.jpg"
    camera = frames[0].views["rgb"].camera.resized(*size)
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": size[0], "h": size[1]}
    _write_points(folder / "points.ply", source)
    content = {**intrinsics, **DISTORTION, "ply_file_path": "points.ply", "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


def _enlarged(image: np.ndarray, size: tuple[int, int], seed: int) -> np.ndarray:
    """An image of the wanted size with noise, in OpenCV's order of colours."""
    colors = image if image.dtype == np.uint8 else np.repeat(np.rint(255 * image), 3, axis=-1)
    large = cv2.resize(colors.astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(seed).normal(0, NOISE, large.shape)
    return np.clip(np.rint(large + noise), 0, 255).astype(np.uint8)[..., ::-1]


def _write_points(path: Path, source: Capture) -> None:
    header = ["ply", "format ascii 1.0", f"element vertex {len(source.points)}"]
    header += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    rows = [
        " ".join([*(f"{number:.7g}" for number in point), *map(str, color)])
        for point, color in zip(source.points.tolist(), source.point_colors.tolist())
    ]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n", encoding="ascii")
