"""A capture of a known scene by a hand-held camera whose thermal images are read line by line.

The scene is a trained one. Every line of a thermal image is a line of an image that a camera at rest takes at the time
at which that line is read, so nothing of the renderer's own rolling shutter is in it. Photographs are taken at once, in
the middle of the readout.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.cameras import Camera, LensCoefficients
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import ViewTensors, lens_tensor
from thermosplat.evaluation.loaded_run import LoadedRun
from thermosplat.novel_views.camera_paths import focus_point, look_to
from thermosplat.runs.atomic_writes import write_text

Array = NDArray[np.float64]
ROLLING = "thermal"
"""The spectrum whose images are read line by line."""
CENTIKELVIN = 100.0
ABSOLUTE_ZERO = -273.15


@dataclass(frozen=True)
class HandHeld:
    """A camera that is carried round a scene and shaken.

    Args:
        focus: What it is turned to, [3].
        up: Upwards, a unit vector, [3].
        level: Two unit vectors across it, [2, 3].
        radius: Of its way about the focus [world units].
        height: Above the focus [world units].
        start: Where the way begins [rad].
        pace: How fast it goes round [rad/s].
        swings: Amplitude [rad] and frequency [Hz] of its pan, its tilt and its roll.
    """

    focus: Array
    up: Array
    level: Array
    radius: float
    height: float
    start: float
    pace: float
    swings: tuple[tuple[float, float], ...] = ((0.10, 0.8), (0.07, 1.1), (0.04, 0.6))

    @classmethod
    def through(cls, viewmats: Array, seconds: float, arc: float) -> "HandHeld":
        """A way among the cameras of a capture, over an arc [rad] of theirs."""
        poses = np.linalg.inv(viewmats)
        focus, up = focus_point(poses), -poses[:, :3, 1].mean(axis=0)
        up = up / np.linalg.norm(up)
        offsets = poses[:, :3, 3] - focus
        heights = offsets @ up
        across = offsets[0] - heights[0] * up
        first = across / np.linalg.norm(across)
        level = np.stack([first, np.cross(up, first)])
        around = offsets @ level.T
        angles = np.unwrap(np.sort(np.arctan2(around[:, 1], around[:, 0])))
        middle = float(np.median(angles))
        radius = float(np.median(np.linalg.norm(around, axis=1)))
        return cls(focus, up, level, radius, float(np.median(heights)), middle - arc / 2, arc / seconds)

    def viewmat(self, time: float) -> Array:
        """World to camera at a time [s], [4, 4]."""
        angle = self.start + self.pace * time
        outward = np.cos(angle) * self.level[0] + np.sin(angle) * self.level[1]
        center = self.focus + self.radius * outward + self.height * self.up
        pose = np.eye(4)
        (pan, tilt, roll) = (size * np.sin(2 * np.pi * rate * time + size) for size, rate in self.swings)
        pose[:3, :3] = cv2.Rodrigues(np.array([tilt, pan, roll]))[0]
        return np.asarray(pose @ look_to(center, self.focus - center, self.up))


class Readouts(NamedTuple):
    """When images are taken and how long they are read."""

    times: Array
    """Of the middle of each readout [s]."""
    seconds: float
    """From the first line to the last [s]."""


class Film(NamedTuple):
    """The images that were taken, and what they are of."""

    cameras: dict[str, Camera]
    """By spectrum."""
    viewmats: Array
    """Poses at the middle of each readout, [F, 4, 4]."""
    ends: Array
    """Those at its first and its last line, [F, 2, 4, 4]."""
    celsius: tuple[float, float]
    """Temperatures of intensity 0 and 1."""


@torch.no_grad()
def still_image(truth: LoadedRun, view: ViewTensors, spectrum: str) -> Tensor:
    """What a camera at rest sees, [H, W, C] in [0, 1]."""
    rendered = truth.model.render({spectrum: view}, sh_degree=truth.sh_degree)
    return rendered.images[spectrum].clamp(0, 1)


def line_by_line(truth: LoadedRun, camera: Camera, path: HandHeld, time: float, seconds: float) -> Tensor:
    """A thermal image whose lines are those of as many images of cameras at rest, [H, W, 1]."""
    lines = []
    for line in range(camera.height):
        share = line / max(camera.height - 1, 1) - 0.5
        view = resting(camera, path.viewmat(time + share * seconds), truth.device)
        lines.append(still_image(truth, view, ROLLING)[line])
    return torch.stack(lines)


def resting(camera: Camera, viewmat: Array, device: torch.device) -> ViewTensors:
    """A camera at rest on a device."""
    return ViewTensors(
        torch.tensor(viewmat, dtype=torch.float32, device=device),
        torch.tensor(camera.K, dtype=torch.float32, device=device),
        camera.width,
        camera.height,
        lens=lens_tensor(camera, device),
    )


def write_capture(
    truth: LoadedRun,
    capture: Capture,
    out: Path,
    path: HandHeld,
    readouts: Readouts,
    width: int,
    radial: tuple[float, float],
) -> Film:
    """Film the scene, and write the images with a COLMAP model of their poses at the middle of the readout.

    Images that are there stay.

    Args:
        truth: The scene.
        capture: The capture that it was trained on: cameras, and points to start from.
        out: The new capture's folder.
        path: How the camera moves.
        readouts: When images are taken.
        width: Of the images [px].
        radial: k1 and k2 of the thermal camera's lens.

    Raises:
        ValueError: The scene's thermal images are no temperatures.
    """
    scale = truth.scales[ROLLING]
    if scale.kind != "scalar" or scale.range is None:
        raise ValueError("The scene must be trained on temperatures: --thermal.source raw.")
    low, high = scale.range
    cameras = {}
    for name in truth.model.spectra:
        given = next(frame.views[name].camera for frame in capture.train if name in frame.views)
        resized = replace(given, lens=None, distortion=None).resized(width, round(given.height * width / given.width))
        bends = LensCoefficients("pinhole", (*radial, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0))
        cameras[name] = replace(resized, lens=bends if name == ROLLING and any(radial) else None)
        (out / "images" / name).mkdir(parents=True, exist_ok=True)
    viewmats = np.stack([path.viewmat(time) for time in readouts.times])
    for number, (time, viewmat) in enumerate(zip(readouts.times, viewmats, strict=True)):
        for name, camera in cameras.items():
            file = str(out / "images" / name / f"{number:04d}.png")
            if Path(file).exists():
                continue
            if name == ROLLING:
                image = line_by_line(truth, camera, path, time, readouts.seconds).cpu().numpy()[..., 0]
                kelvin = low + image.astype(np.float64) * (high - low) - ABSOLUTE_ZERO
                cv2.imwrite(file, np.round(CENTIKELVIN * kelvin).astype(np.uint16))
            else:
                image = still_image(truth, resting(camera, viewmat, truth.device), name).cpu().numpy()
                cv2.imwrite(file, np.round(255 * image[..., ::-1]).astype(np.uint8))
    write_text(out / "images" / ROLLING / "units.json", json.dumps({"unit": "centikelvin"}))
    _write_model(out / "sparse" / "0", cameras, viewmats, capture)
    ends = [[path.viewmat(time + half * readouts.seconds) for half in (-0.5, 0.5)] for time in readouts.times]
    return Film(cameras, viewmats, np.array(ends), (low, high))


def _write_model(folder: Path, cameras: dict[str, Camera], viewmats: Array, capture: Capture) -> None:
    """A COLMAP model as text."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for number, camera in enumerate(cameras.values(), start=1):
        k1, k2 = (0.0, 0.0) if camera.lens is None else camera.lens.radial[:2]
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, k1, k2, 0.0, 0.0)
        model, count = ("PINHOLE", 4) if camera.lens is None else ("OPENCV", 8)
        lines.append(f"{number} {model} {camera.width} {camera.height} {_words(numbers[:count])}")
    write_text(folder / "cameras.txt", "\n".join(lines) + "\n")
    images, identity = [], 0
    for number, viewmat in enumerate(viewmats):
        x, y, z, w = pycolmap.Rotation3d(viewmat[:3, :3]).quat
        for camera, name in enumerate(cameras, start=1):
            identity += 1
            images.append(f"{identity} {_words((w, x, y, z, *viewmat[:3, 3]))} {camera} {name}/{number:04d}.png\n\n")
    write_text(folder / "images.txt", "".join(images))
    points = zip(capture.points, capture.point_colors, strict=True)
    texts = [f"{i} {_words(place)} {' '.join(map(str, color))} 0" for i, (place, color) in enumerate(points, start=1)]
    write_text(folder / "points3D.txt", "\n".join(texts) + "\n")


def _words(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)
