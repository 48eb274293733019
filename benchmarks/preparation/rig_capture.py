"""A capture of a rig whose true cameras are known, as they are or disturbed, and how far off its thermal camera is.

The files are those of ``data/rig_desk``: visible/VIS_*.jpg, thermal/IR_*.tiff and truth.json.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.datasets.cameras import camera_center
from thermosplat.datasets.capture import Capture
from thermosplat.runs.atomic_writes import write_text

Array = NDArray[np.float64]
DEPTHS = (1.2, 2.0, 3.0)
"""Where points are looked at before the thermal camera [m]."""


@dataclass(frozen=True)
class Disturbance:
    """What is wrong with the cameras."""

    degrees: float = 0.0
    """Turn of the thermal camera in the rig."""
    meters: float = 0.0
    """Its motion."""
    focal_factor: float = 1.0
    """Of its focal length."""
    pose_degrees: float = 0.0
    """Turn of every exposure as a whole, about an axis of its own."""
    pose_share: float = 0.0
    """Its motion, as a share of the cameras' extent: the largest distance from their mean place."""

    def of_rig(self) -> Array:
        """The thermal camera's motion, in an arbitrary but fixed direction, shape [4, 4]."""
        return _motion(np.random.default_rng(3), self.degrees, self.meters)

    def of_poses(self, places: Array) -> list[Array]:
        """The motion of each exposure, shape [4, 4], in an arbitrary but fixed direction.

        Args:
            places: Where the cameras stand [m], shape [F, 3].
        """
        random, extent = np.random.default_rng(4), np.linalg.norm(places - places.mean(axis=0), axis=1).max()
        return [_motion(random, self.pose_degrees, self.pose_share * extent) for _ in places]


def write_capture(source: Path, points: Path, out: Path, wrong: Disturbance, shrink: tuple[int, int]) -> None:
    """Write a COLMAP rig capture.

    Args:
        source: Folder with the files.
        points: COLMAP model with the scene's points.
        out: The capture's folder.
        wrong: What is wrong with the thermal camera.
        shrink: What the sides of photographs and of thermal images are divided by.
    """
    truth = json.loads((source / "truth.json").read_text())
    for name, folder, factor in (("rgb", "visible", shrink[0]), ("thermal", "thermal", shrink[1])):
        (out / "images" / name).mkdir(parents=True, exist_ok=True)
        for path in sorted((source / folder).iterdir()):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            size = image.shape[1] // factor, image.shape[0] // factor
            smaller = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA).round()
            cv2.imwrite(str(out / "images" / name / path.name), smaller.astype(image.dtype))
    to_thermal = np.linalg.inv(np.array(truth["thermal_to_visible"]) @ wrong.of_rig())
    cameras = [_camera(1, truth["visible"], 1.0), _camera(2, truth["thermal"], wrong.focal_factor)]
    frames, images = [], []
    names = sorted(truth["camera_to_world"])
    poses = [np.array(truth["camera_to_world"][name]) for name in names]
    moved = wrong.of_poses(np.array([pose[:3, 3] for pose in poses]))
    for number, (name, pose, motion) in enumerate(zip(names, poses, moved, strict=True), start=1):
        visible = np.linalg.inv(pose @ motion)
        first, second = 2 * number - 1, 2 * number
        frames.append(f"{number} 1 {_pose(visible)} 2 CAMERA 1 {first} CAMERA 2 {second}\n")
        thermal_name = name.replace("VIS", "IR").replace(".jpg", ".tiff")
        images += [f"{first} {_pose(visible)} 1 rgb/{name}\n\n"]
        images += [f"{second} {_pose(to_thermal @ visible)} 2 thermal/{thermal_name}\n\n"]
    known = pycolmap.Reconstruction(points).points3D.items()
    texts = {
        "cameras.txt": "".join(cameras),
        "rigs.txt": f"1 2 CAMERA 1 CAMERA 2 1 {_pose(to_thermal)}\n",
        "frames.txt": "".join(frames),
        "images.txt": "".join(images),
        "points3D.txt": "".join(f"{i} {_words([*p.xyz])} {_words([*map(int, p.color)])} 0\n" for i, p in known),
    }
    for file, text in texts.items():
        write_text(out / "sparse" / "0" / file, text)


def thermal_errors(source: Path, found: Capture, given: Capture, wrong: Disturbance) -> Array:
    """How far points land in the untouched thermal images from where the true camera sees them [px], flat.

    Where poses were wrong, after the similarity that takes the true places of the photographs to the found ones: the
    mean over all poses is held, so a scene stays as far off as the poses were in the mean.

    Args:
        source: Folder with the truth.
        found: The capture with its cameras as training found them.
        given: The capture as it was read.
        wrong: What was wrong with its thermal camera.
    """
    truth = json.loads((source / "truth.json").read_text())
    camera = truth["thermal"]
    x, y = np.meshgrid(np.linspace(20, camera["width"] - 20, 12), np.linspace(20, camera["height"] - 20, 9))
    slopes = np.column_stack([(x.ravel() - camera["cx"]) / camera["fx"], (y.ravel() - camera["cy"]) / camera["fy"]])
    true_places = _untouched(slopes, camera, 1.0)
    to_found = pycolmap.Sim3d()
    if wrong.pose_degrees > 0 or wrong.pose_share > 0:
        true_poses = [np.array(truth["camera_to_world"][frame.views["rgb"].path.name]) for frame in found.train]
        found_centers = np.array([camera_center(frame.views["rgb"].viewmat) for frame in found.train])
        to_found = pycolmap.estimate_sim3d(np.array([pose[:3, 3] for pose in true_poses]), found_centers)
    similarity = np.vstack([to_found.matrix(), [0.0, 0.0, 0.0, 1.0]])
    errors = []
    for frame, before in zip(found.train, given.train, strict=True):
        view, lens = frame.views["thermal"], before.views["thermal"].camera
        pose = np.array(truth["camera_to_world"][frame.views["rgb"].path.name]) @ np.array(truth["thermal_to_visible"])
        for depth in DEPTHS:
            seen = np.column_stack([slopes * depth, np.full(len(slopes), depth), np.ones(len(slopes))])
            local = seen @ pose.T @ similarity.T @ view.viewmat.T
            places = local[:, :2] / local[:, 2:3]
            found_lens = view.camera.lens
            k1, k2 = found_lens.radial[:2] if found_lens is not None else view.camera.distortion or (0.0, 0.0)
            squared = (places**2).sum(axis=1, keepdims=True)
            places = places * (1 + k1 * squared + k2 * squared**2)
            pixels = places * [view.camera.fx, view.camera.fy] + [view.camera.cx, view.camera.cy]
            if found_lens is not None:  # images are as they were taken, but for their size
                found_places = pixels * (camera["width"] / view.camera.width)
            else:
                straight = (pixels - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
                found_places = _untouched(straight, camera, wrong.focal_factor)
            errors.append(np.linalg.norm(found_places - true_places, axis=1))
    return np.concatenate(errors)


def _motion(random: np.random.Generator, degrees: float, meters: float) -> Array:
    axis, way = random.normal(size=(2, 3))
    moved = np.eye(4)
    moved[:3, :3] = cv2.Rodrigues(np.radians(degrees) * axis / np.linalg.norm(axis))[0]
    moved[:3, 3] = meters * way / np.linalg.norm(way)
    return moved


def _untouched(slopes: Array, camera: dict[str, Any], focal_factor: float) -> Array:
    """Pixels of the untouched image at slopes x / z, y / z, shape [N, 2]."""
    squared = (slopes**2).sum(axis=1, keepdims=True)
    bent = slopes * (1 + camera["k1"] * squared + camera["k2"] * squared**2)
    return np.asarray(bent * focal_factor * [camera["fx"], camera["fy"]] + [camera["cx"], camera["cy"]])


def _camera(number: int, lens: dict[str, Any], focal_factor: float) -> str:
    parameters = [focal_factor * lens["fx"], focal_factor * lens["fy"], lens["cx"], lens["cy"], lens["k1"], lens["k2"]]
    return f"{number} OPENCV {lens['width']} {lens['height']} {_words(parameters)} 0 0\n"


def _pose(matrix: Array) -> str:
    x, y, z, w = pycolmap.Rotation3d(matrix[:3, :3]).quat
    return _words([w, x, y, z, *matrix[:3, 3]])


def _words(numbers: list[Any]) -> str:
    return " ".join(repr(number if isinstance(number, int) else float(number)) for number in numbers)
