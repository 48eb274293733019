"""Pose and intrinsics of a transforms file's frame.

Poses have OpenGL axes (y up, z backwards). Intrinsics are global or per frame; distortion follows `camera_model`.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.values import shortened, shown
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.lens import Lens
from thermosplat.errors import UserError

_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_PINHOLE = ("fl_x", "fl_y", "cx", "cy")
_PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
_DISTORTION = {
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""Distortion parameters of nerfstudio's camera models, in COLMAP's order."""
_SAME_AS = {
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}
"""Models with fewer of the same coefficients: the others are 0."""
_POSE = "Expected a 4x4 camera-to-world matrix with a rotation of unit length, as nerfstudio writes it."
_INTRINSICS = "Expected numbers in pixels, for all frames or for each: w, h, fl_x, fl_y, cx, cy, k1, k2, p1, p2."
_COEFFICIENTS = sorted({key for keys in _DISTORTION.values() for key in keys})


def frame_viewmat(entry: dict[str, Any], path: Path, number: int) -> NDArray[np.float64]:
    """World-to-camera pose with OpenCV axes from the camera-to-world pose with OpenGL axes."""
    try:
        pose = np.array(entry["transform_matrix"], np.float64)
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise UserError(f"Frame {number} of {path} has no transform_matrix of numbers.", _POSE) from error
    if pose.shape not in ((4, 4), (3, 4)):
        raise UserError(f"Frame {number} of {path}: transform_matrix must be 4x4, got shape {pose.shape}.", _POSE)
    if not np.isfinite(pose).all():
        raise UserError(f"Frame {number} of {path}: transform_matrix holds a NaN or an infinity.", _POSE)
    pose = np.vstack([pose[:3], [0, 0, 0, 1]])
    if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3) or np.linalg.det(pose[:3, :3]) < 0:
        raise UserError(f"Frame {number} of {path}: transform_matrix is no rotation with a translation.", _POSE)
    return np.asarray(np.linalg.inv(pose @ _OPENGL_TO_OPENCV), np.float64)


def frame_lens(entry: dict[str, Any], content: dict[str, Any], path: Path, number: int, image: Path | None) -> Lens:
    """Intrinsics of a frame, its own or the file's."""
    stated = {**content, **{key: value for key, value in entry.items() if value is not None}}
    width, height = stated.get("w"), stated.get("h")
    if (width is None or height is None) and image is not None:
        height, width = read_image(image).shape[:2]
    if width is None or height is None:
        raise UserError(f"Frame {number} of {path} has no image size (w, h).", _INTRINSICS)
    try:
        if "fl_x" not in stated and "camera_angle_x" in stated:
            stated["fl_x"] = 0.5 * float(width) / np.tan(0.5 * float(stated["camera_angle_x"]))
        stated.setdefault("fl_y", stated["fl_x"])
        stated.setdefault("cx", float(width) / 2)
        stated.setdefault("cy", float(height) / 2)
        pinhole = tuple(float(stated[key]) for key in _PINHOLE)
        size = int(width), int(height)
        coefficients = {key: float(stated.get(key) or 0) for key in _COEFFICIENTS}
    except KeyError as error:
        raise UserError(f"Frame {number} of {path} has no focal length (fl_x, fl_y).", _INTRINSICS) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"Frame {number} of {path} has intrinsics that are no numbers: {shortened(str(error))}.", _INTRINSICS
        ) from error
    model = str(stated.get("camera_model") or "OPENCV")
    if model in _PINHOLE_MODELS:
        return Lens("PINHOLE", pinhole, *size)
    if model not in (*_PINHOLE_MODELS, *_SAME_AS, *_DISTORTION):
        raise UserError(
            f"Frame {number} of {path} has the camera model {shown(model)}, which is not known.",
            f"Known are {', '.join((*_PINHOLE_MODELS, *_SAME_AS, *_DISTORTION))}: "
            "undistort the images to one of them (colmap image_undistorter gives PINHOLE).",
        )
    model = _SAME_AS.get(model, model)
    if model == "OPENCV" and coefficients["k3"] != 0:
        model = "FULL_OPENCV"
    distortion = tuple(coefficients[key] for key in _DISTORTION[model])
    if not any(distortion) and model != "OPENCV_FISHEYE":
        return Lens("PINHOLE", pinhole, *size)
    return Lens(model, pinhole + distortion, *size)
