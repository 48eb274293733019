"""How far a prepared capture is from the rig that rendered its files.

``truth.json`` has both lenses (OPENCV, pixel centres at halves), ``thermal_to_visible`` [4, 4] and ``camera_to_world``
[4, 4] of each photograph by its file name, in metres and OpenCV axes. Thermal files are called IR_0001 beside VIS_0001.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]
_DEPTHS = (1.2, 2.0, 3.0)
"""[m] at which thermal pixels are followed; the scene lies between them."""
_GRID, _RIM = (12, 9), 20.0
"""Pixels that are followed per image, and their distance [px] from its rim."""


@dataclass(frozen=True)
class RigErrors:
    """Medians over the photographs and over the followed thermal pixels.

    Args:
        degrees: Angle between a photograph's true and found rotation, after a similarity.
        extent: Distance between its true and found place, as a share of the cameras' extent.
        pixels: Distance between where a true point lands in the thermal image and where the truth has it [px].
        pixels_95: The 95th percentile of that.
        pairs: Exposures with a pose of both images.
    """

    degrees: float
    extent: float
    pixels: float
    pixels_95: float
    pairs: int


def rig_errors(sparse: Path, truth_json: Path) -> RigErrors:
    """Compare the model of a prepared capture with the truth."""
    truth: dict[str, Any] = json.loads(truth_json.read_text())
    model = pycolmap.Reconstruction(sparse)
    images = {Path(image.name).stem: image for image in model.images.values() if image.has_pose}
    true = {Path(name).stem: np.array(pose) for name, pose in truth["camera_to_world"].items()}
    names = sorted(true.keys() & images.keys())
    centres = np.array([true[name][:3, 3] for name in names])
    to_model = pycolmap.estimate_sim3d(centres, np.array([images[name].projection_center() for name in names]))
    turn, scale = to_model.rotation.matrix(), to_model.scale
    found = np.array([images[name].projection_center() for name in names])
    places = np.linalg.norm(found - _moved(to_model, centres), axis=1) / scale
    extent = np.linalg.norm(centres - centres.mean(0), axis=1).max()
    degrees = [_angle(images[name].cam_from_world().rotation.matrix() @ turn @ true[name][:3, :3]) for name in names]
    lens = truth["thermal"]
    camera = pycolmap.Camera(
        model="OPENCV",
        width=lens["width"],
        height=lens["height"],
        params=[lens[key] for key in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")],
    )
    both = [name for name in names if name.replace("VIS", "IR") in images]
    pixels = [
        _landed(images[name.replace("VIS", "IR")], model, camera, true[name] @ truth["thermal_to_visible"], to_model)
        for name in both
    ]
    every = np.concatenate(pixels) if pixels else np.array([np.nan])
    return RigErrors(
        float(np.median(degrees)),
        float(np.median(places) / extent),
        float(np.median(every)),
        float(np.percentile(every, 95)),
        len(both),
    )


def _moved(similarity: pycolmap.Sim3d, points: Array) -> Array:
    return similarity.scale * points @ similarity.rotation.matrix().T + similarity.translation


def _angle(rotation: Array) -> float:
    """The angle [°] of a rotation [3, 3]."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


def _landed(
    image: pycolmap.Image,
    model: pycolmap.Reconstruction,
    lens: pycolmap.Camera,
    camera_to_world: Array,
    to_model: pycolmap.Sim3d,
) -> Array:
    """Distances [px] between true pixels and where their points land in the found camera."""
    sides = [np.linspace(_RIM, side - _RIM, count) for side, count in zip((lens.width, lens.height), _GRID)]
    grid = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
    rays = np.column_stack([lens.cam_from_img(grid), np.ones(len(grid))])
    found = model.cameras[image.camera_id]
    pose = image.cam_from_world().matrix()
    distances = []
    for depth in _DEPTHS:
        world = depth * rays @ camera_to_world[:3, :3].T + camera_to_world[:3, 3]
        local = _moved(to_model, world) @ pose[:, :3].T + pose[:, 3]
        distances.append(np.linalg.norm(found.img_from_cam(local) - grid, axis=1))
    return np.concatenate(distances)
