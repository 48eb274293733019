"""Pose and intrinsics of a transforms file's frame.

Poses have OpenGL axes (y up, z backwards). Intrinsics are global or per frame. What coefficients mean is what the
programs that write and read such files take them for:

- nerfstudio's perspective models, whatever their names, bend by k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸ and p1, p2
  (its ``camera_utils``); k4 has no place in a COLMAP model, and nerfstudio itself does not undistort it.
- Its OPENCV_FISHEYE does the same to the angle θ in place of r, with p1 and p2: COLMAP's THIN_PRISM_FISHEYE.
- instant-ngp's files name no model: "is_fisheye" says that it is OpenCV's fisheye model (its ``colmap2nerf``).
- FULL_OPENCV is COLMAP's: k4 to k6 are the denominator.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.values import shortened, shown
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.lens import CUT_PANORAMAS, Lens
from thermosplat.errors import UserError

_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_PINHOLE = ("fl_x", "fl_y", "cx", "cy")
_COEFFICIENTS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE"), ()),
    **dict.fromkeys(("SIMPLE_RADIAL", "RADIAL", "OPENCV"), ("k1", "k2", "p1", "p2", "k3")),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    **dict.fromkeys(
        ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"), ("k1", "k2", "p1", "p2", "k3", "k4")
    ),
}
"""Coefficients that each camera model has a place for, in the order of COLMAP's model that has the most of them."""
_COEFFICIENT = re.compile(r"[bkps][1-9]")
"""Radial, tangential, thin prism and, of Metashape, affinity."""
_LISTED = ("k1", "k2", "k3", "k4", "p1", "p2")
"""What nerfstudio's "distortion_params" list."""
_PANORAMAS = re.compile(r"equirectangular|latlong|omnidirectionalstereo_[lr]|vr180_[lr]", re.IGNORECASE)
"""Models of nerfstudio and flags of instant-ngp."""
_FLAGS = ("equirectangular", "latlong", "orthographic", "ftheta_p0")
"""Keys by which instant-ngp's files say that they have another projection."""
_POSE = "Expected a 4x4 camera-to-world matrix with a rotation of unit length, as nerfstudio writes it."
_INTRINSICS = "Expected numbers in pixels, for all frames or for each: w, h, fl_x, fl_y, cx, cy, k1, k2, p1, p2."


def frame_viewmat(entry: dict[str, Any], path: Path, number: int, *, to_camera: bool = False) -> NDArray[np.float64]:
    """World-to-camera pose, OpenCV axes; from camera to world, OpenGL axes, or ``to_camera`` as it is stated."""
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
    return pose if to_camera else np.asarray(np.linalg.inv(pose @ _OPENGL_TO_OPENCV), np.float64)


def frame_lens(entry: dict[str, Any], content: dict[str, Any], path: Path, number: int, image: Path | None) -> Lens:
    """Intrinsics of a frame, its own or the file's."""
    stated = {**content, **{key: value for key, value in entry.items() if value is not None}}
    width, height = stated.get("w"), stated.get("h")
    if (width is None or height is None) and image is not None:
        height, width = read_image(image).shape[:2]
    if width is None or height is None:
        raise UserError(f"Frame {number} of {path} has no image size (w, h).", _INTRINSICS)
    where = f"Frame {number} of {path}"
    model = _model(stated, where)
    stated |= _listed_coefficients(stated.get("distortion_params"), where)
    try:
        for axis, side in (("x", width), ("y", height)):
            if f"fl_{axis}" not in stated and f"camera_angle_{axis}" in stated:
                stated[f"fl_{axis}"] = 0.5 * float(side) / np.tan(0.5 * float(stated[f"camera_angle_{axis}"]))
        stated.setdefault("fl_y", stated["fl_x"])
        stated.setdefault("cx", float(width) / 2)
        stated.setdefault("cy", float(height) / 2)
        pinhole = tuple(float(stated[key]) for key in _PINHOLE)
        size = int(width), int(height)
        coefficients = {key: float(stated[key] or 0) for key in stated if _COEFFICIENT.fullmatch(key)}
    except KeyError as error:
        raise UserError(f"{where} has no focal length (fl_x, fl_y).", _INTRINSICS) from error
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{where} has intrinsics that are no numbers: {shortened(str(error))}.", _INTRINSICS) from error
    distortion = {key: value for key, value in coefficients.items() if value}
    if strange := sorted(distortion.keys() - set(_COEFFICIENTS[model])):
        raise UserError(
            f"{where} has the camera model {model} and {strange[0]} = {distortion[strange[0]]:g}, which is none of its "
            f"coefficients ({', '.join(_COEFFICIENTS[model]) or 'it has none'}).",
            "Undistort the images in the program that calibrated them, export them as a COLMAP model, or remove the "
            "coefficient if the images are undistorted already.",
        )
    fisheye = model.endswith("FISHEYE")
    if not distortion and not fisheye:
        return Lens("PINHOLE", pinhole, *size)
    if model == "FULL_OPENCV" or (not fisheye and "k3" in distortion):
        lens, names = "FULL_OPENCV", _COEFFICIENTS["FULL_OPENCV"]
    elif fisheye and distortion.keys() & {"p1", "p2"}:
        lens, names = "THIN_PRISM_FISHEYE", (*_COEFFICIENTS[model], "sx1", "sy1")
    else:
        lens = "OPENCV_FISHEYE" if fisheye else "OPENCV"
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    return Lens(lens, pinhole + tuple(distortion.get(name, 0.0) for name in names), *size)


def _listed_coefficients(listed: Any, where: str) -> dict[str, Any]:
    """What nerfstudio's "distortion_params" say, where there are any."""
    if listed is None:
        return {}
    if not isinstance(listed, list) or len(listed) != len(_LISTED):
        raise UserError(f"{where} has distortion_params that are no list of {', '.join(_LISTED)}.", _INTRINSICS)
    return dict(zip(_LISTED, listed, strict=True))


def _model(stated: dict[str, Any], where: str) -> str:
    """The camera model of a frame, one of those that are known."""
    flagged = next((flag for flag in _FLAGS if stated.get(flag)), None)
    fisheye = bool(stated.get("is_fisheye"))
    model = str(flagged or stated.get("camera_model") or ("OPENCV_FISHEYE" if fisheye else "OPENCV"))
    if _PANORAMAS.fullmatch(model):
        raise UserError(f"{where} is {model}: images of 360 degrees are not read.", CUT_PANORAMAS)
    if model not in _COEFFICIENTS:
        raise UserError(
            f"{where} has the camera model {shown(model)}, which is not known.",
            f"Known are {', '.join(_COEFFICIENTS)}: "
            "undistort the images to one of them (colmap image_undistorter gives PINHOLE).",
        )
    if fisheye and not model.endswith("FISHEYE"):
        raise UserError(
            f"{where} has the camera model {model} and says is_fisheye.", "Remove the one of the two that is wrong."
        )
    return model
