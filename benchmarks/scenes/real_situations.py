"""A good capture made into what people come with: few points, other units, wrong poses, light that changes, and so on.

Each situation changes one thing of a capture of RGB and thermal images. Held-out images stay as they are, so that what
they are compared with is the scene.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.thermal.intensity import pixel_intensity

GAMMA = 2.2
"""Between linear light and the values of a photograph."""
LAMP = 300.0
"""Temperature of the hot lamp [°C]."""
_THERMAL_BLUR = 0.003
"""Standard deviation of the thermal camera's point spread [image widths], that of the rendered captures."""


@dataclass(frozen=True)
class Change:
    """What a situation does to a capture; nothing where it is silent."""

    points: int | None = None
    """So many of the sparse points are left."""
    scale: float = 1.0
    """Of the world."""
    views: int | None = None
    """So many training frames: fewer are spread over all, more are copies with noise of their own."""
    degrees: float = 0.0
    """By which training poses are turned about a random axis, each by itself [°]."""
    picture: Callable[[NDArray[np.float64], str, int, np.random.Generator], NDArray[np.float64]] | None = None
    """Image [H, W, C] in [0, 1], spectrum and number of a training frame to the image in its place."""
    lamp: bool = False
    """A lamp of 300 °C hangs in the scene, in all images: the thermal range is stretched to it."""


def stops(image: NDArray[np.float64], spectrum: str, number: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Every second photograph has two stops more light."""
    if spectrum != "rgb" or number % 2:
        return image
    return np.clip(4.0 * image**GAMMA, 0.0, 1.0) ** (1.0 / GAMMA)


def clipped(image: NDArray[np.float64], spectrum: str, number: int, random: np.random.Generator) -> NDArray[np.float64]:
    """What is brighter than two thirds of the range in a photograph is white, as a lamp is."""
    return np.clip(1.5 * image, 0.0, 1.0) if spectrum == "rgb" else image


def blurred(image: NDArray[np.float64], spectrum: str, number: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Every third image was taken in motion: lines of a thirtieth of its width."""
    if number % 3:
        return image
    length = max(3, image.shape[1] // 30)
    kernel = np.zeros((length, length))
    kernel[length // 2] = 1.0 / length
    turn = cv2.getRotationMatrix2D(((length - 1) / 2, (length - 1) / 2), random.uniform(0, 180), 1.0)
    kernel = cv2.warpAffine(kernel, turn, (length, length))
    return cv2.filter2D(image, -1, kernel / kernel.sum()).reshape(image.shape)


def person(image: NDArray[np.float64], spectrum: str, number: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Somebody stands in half of the images, each time elsewhere: dark in photographs, warm in thermal images."""
    place = np.random.default_rng(number).uniform(0.1, 0.9)  # the same in both spectra
    if number % 2:
        return image
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    center = (int(place * width), int(0.6 * height))
    cv2.ellipse(mask, center, (max(1, width // 20), max(1, height // 3)), 0, 0, 360, 1, -1)
    color = np.array([0.15, 0.12, 0.2] if spectrum == "rgb" else [0.8])
    return np.where(mask[..., None] > 0, color, image)


SITUATIONS: dict[str, Change] = {
    "as it is": Change(),
    "100 points": Change(points=100),
    "no points": Change(points=0),
    "units 0.01": Change(scale=0.01),
    "units 100": Change(scale=100.0),
    "8 views": Change(views=8),
    "20 views": Change(views=20),
    "200 views": Change(views=200),
    "two stops": Change(picture=stops),
    "poses off by 0.5°": Change(degrees=0.5),
    "clipped lamps": Change(picture=clipped),
    "blurred frames": Change(picture=blurred),
    "moving person": Change(picture=person),
    "hot lamp": Change(lamp=True),
}
"""By name. Turning on the spot and a straight flight are captures of their own (room, lab)."""


def situation(source: Capture, name: str, folder: Path, seed: int = 0) -> Path:
    """Write a capture in nerfstudio's layout, changed as a situation says.

    Args:
        source: A capture of RGB and thermal images that share their cameras. Pseudo-colours become values.
        name: One of ``SITUATIONS``.
        folder: Where; it is made.
        seed: Of what is random.

    Returns:
        The folder.
    """
    change, random = SITUATIONS[name], np.random.default_rng(seed)
    train = list(source.train)
    if change.views is not None and change.views <= len(train):
        train = [train[round((i + 0.5) * len(train) / change.views - 0.5)] for i in range(change.views)]
    copies = 0 if change.views is None else max(0, change.views - len(train))
    train += [train[i % len(train)] for i in range(copies)]
    lamp = _lamp(source) if change.lamp else None
    entries: dict[str, list[dict[str, Any]]] = {"train": [], "test": []}
    for split, frames in (("train", train), ("test", source.test)):
        for number, frame in enumerate(frames):
            is_copy = split == "train" and number >= len(train) - copies
            stem = f"{split}_{number:04d}"
            for spectrum, sub in (("rgb", "images"), ("thermal", "thermal")):
                image = _picture(frame, spectrum, source, lamp)
                if split == "train" and change.picture is not None:
                    image = change.picture(image, spectrum, number, random)
                if is_copy:
                    image = np.clip(image + random.normal(0.0, 0.01, image.shape), 0.0, 1.0)
                _write(folder / sub / f"{stem}.png", image)
            to_world = np.linalg.inv(frame.views["rgb"].viewmat)
            if split == "train" and change.degrees:
                axis = random.normal(size=3)
                to_world[:3, :3] = (
                    to_world[:3, :3] @ cv2.Rodrigues(math.radians(change.degrees) * axis / np.linalg.norm(axis))[0]
                )
            to_world[:3, 3] *= change.scale
            pose = to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes
            entries[split].append(
                {
                    "file_path": f"images/{stem}.png",
                    "thermal_file_path": f"thermal/{stem}.png",
                    "transform_matrix": pose.tolist(),
                }
            )
    camera = source.train[0].views["rgb"].camera
    content = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    content |= {"w": camera.width, "h": camera.height, "frames": entries["train"] + entries["test"]}
    content |= {f"{split}_filenames": [one["file_path"] for one in found] for split, found in entries.items()}
    count = len(source.points) if change.points is None else change.points
    if count:
        chosen = random.permutation(len(source.points))[:count]
        _write_points(folder / "points.ply", change.scale * source.points[chosen], source.point_colors[chosen])
        content["ply_file_path"] = "points.ply"
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return folder


def _lamp(source: Capture) -> NDArray[np.float64]:
    """Where the lamp hangs: above the middle of the points."""
    middle = np.median(source.points.astype(np.float64), axis=0)
    centers = [np.linalg.inv(frame.views["rgb"].viewmat)[:3, 3] for frame in source.train]
    return middle + 0.3 * (np.mean(centers, axis=0) - middle)


def _picture(frame: Frame, spectrum: str, source: Capture, lamp: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """The image of a frame in [0, 1]; thermal values in the range that the lamp stretches, where there is one."""
    view = frame.views[spectrum]
    pixels = view.pixels()
    image = pixels.image / 255.0 if pixels.image.dtype == np.uint8 else pixels.image.astype(np.float64)
    if spectrum != "rgb" and image.shape[2] == 3:
        image = pixel_intensity(torch.from_numpy(image).float(), source.scales[spectrum]).double().numpy()[..., None]
    if lamp is None:
        return image
    in_camera = view.viewmat[:3, :3] @ lamp + view.viewmat[:3, 3]
    camera = view.camera
    if spectrum != "rgb":
        low, high = source.scales[spectrum].range
        image = image * (high - low) / (LAMP - low)
    if in_camera[2] <= 0:
        return image
    at = camera.K @ in_camera / in_camera[2]
    radius = max(1, round(0.03 * camera.width))
    lamp_share = cv2.circle(np.zeros(image.shape[:2]), (round(at[0]), round(at[1])), radius, 1.0, -1)
    if spectrum != "rgb":
        lamp_share = cv2.GaussianBlur(lamp_share, (0, 0), _THERMAL_BLUR * camera.width)
    return image + lamp_share[..., None] * (1.0 - image)


def _write(path: Path, image: NDArray[np.float64]) -> None:
    """A photograph or pseudo-colours as 8 bits, values as 16."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.shape[2] == 1:
        cv2.imwrite(str(path), np.rint(image[..., 0] * 65535.0).astype(np.uint16))
    else:
        cv2.imwrite(str(path), np.rint(image[..., ::-1] * 255.0).astype(np.uint8))


def _write_points(path: Path, points: NDArray[np.floating], colors: NDArray[np.uint8]) -> None:
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    header += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    rows = [
        " ".join([*(f"{number:.9g}" for number in point), *map(str, color)])
        for point, color in zip(points.tolist(), colors.tolist(), strict=True)
    ]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n", encoding="ascii")
