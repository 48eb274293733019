"""ThermoScenes and nerfstudio: transforms_thermal.json or transforms.json with a camera-to-world pose per frame.

Poses have OpenGL axes (y up, z backwards). Intrinsics are global or per frame; distortion follows `camera_model`. The
thermal image of a frame is its `thermal_file_path`, else the file of the same stem in thermal/, and shares the RGB
image's camera. Names like frame_train_00001 and frame_eval_00001 state the split, as do train_filenames and
test_filenames. temperature_bounds.json gives the temperatures of black and white.
"""

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.frame_files import FrameFiles, Listing, Shot
from thermosplat.datasets.image_files import list_images, read_image
from thermosplat.datasets.image_names import NamedImages, files_in, frame_names
from thermosplat.datasets.lens import Lens
from thermosplat.datasets.temperature_units import celsius_range, read_json
from thermosplat.datasets.transforms_points import transforms_points
from thermosplat.datasets.transforms_splits import check_stated, stated_splits, with_splits_from_names
from thermosplat.errors import UserError

_NAMES = ("transforms_thermal.json", "transforms.json")
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_PINHOLE = ("fl_x", "fl_y", "cx", "cy")
_DISTORTION = {
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""Distortion parameters of nerfstudio's camera models, in COLMAP's order."""
_COEFFICIENTS = sorted({key for keys in _DISTORTION.values() for key in keys})


def find_transforms(root: Path) -> Path | None:
    """The transforms file of a capture, or None."""
    return next((root / name for name in _NAMES if (root / name).is_file()), None)


def list_transforms(root: Path, path: Path, model_folder: Path | None) -> Listing:
    """Files, cameras and points of a capture in this layout.

    Args:
        root: The capture's folder.
        path: Its transforms file.
        model_folder: A COLMAP model beside it, for its points; or None.

    Raises:
        UserError: The file lacks intrinsics, poses or frames.
    """
    content = read_json(path)
    entries = content.get("frames")
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path} lists no frames.", "Expected nerfstudio's transforms with a list under 'frames'.")
    thermal_files, raw_files = (files_in(root / folder, by_stem=True) for folder in ("thermal", "thermal_raw"))
    names = [_name(root, entry) for entry in entries]
    listed = NamedImages(path.name, [(name, None) for name in names])
    splits, notes = stated_splits(content, path, names)
    called = dict(zip(listed, frame_names(list(listed), path.name), strict=True))
    frames, missing = [], 0
    for number, (name, entry) in enumerate(zip(names, entries, strict=True)):
        if splits is not None and name not in splits:
            continue
        rgb = _file(root, entry.get("file_path"))
        values = _found(raw_files, name, listed)
        thermal = _file(root, entry.get("thermal_file_path")) or _found(thermal_files, name, listed) or values
        if rgb is None and thermal is None:
            missing += 1
            continue
        if rgb == thermal:
            rgb = None
        viewmat = _viewmat(entry, path, number)
        lens = _lens(entry, content, path, number, rgb or thermal)
        frames.append(
            FrameFiles(
                called[name],
                None if rgb is None else Shot(rgb, lens, viewmat),
                None if thermal is None else Shot(thermal, lens, viewmat, values),
                None if splits is None else splits[name],
            )
        )
    if not frames:
        raise UserError(f"None of the {len(entries)} images that {path} lists exists.", "Is it the right folder?")
    if splits is None:
        frames = with_splits_from_names(frames)
    else:
        check_stated(frames, splits, path)
    points, colors, point_notes = transforms_points(root, content, frames, model_folder)
    notes += point_notes
    if missing:
        notes.append(f"{missing} frames of {path.name} have no file and were left out.")
    return Listing(
        "transforms",
        tuple(frames),
        points,
        colors,
        celsius_range=_temperature_bounds(root),
        notes=tuple(notes),
    )


def _name(root: Path, entry: dict[str, Any]) -> PurePosixPath:
    """The image by which a frame is called; below the capture's folder if it lies there, so that folders can pair."""
    stated = PurePosixPath(str(entry.get("file_path") or entry.get("thermal_file_path")))
    folder = root.resolve()
    return stated.relative_to(folder) if stated.is_relative_to(folder) else stated


def _found(files: NamedImages[Path], name: PurePosixPath, listed: NamedImages[None]) -> Path | None:
    """The file of a frame in another folder."""
    found = files.find(name, listed)
    return None if found is None else files[found]


def _file(root: Path, stated: Any) -> Path | None:
    """The file that a frame names, with or without its ending; None if it does not exist."""
    if not stated:
        return None
    path = root / str(stated)
    if path.is_file():
        return path
    return next((file for file in list_images(path.parent) if file.stem == path.name), None)


def _viewmat(entry: dict[str, Any], path: Path, number: int) -> NDArray[np.float64]:
    """World-to-camera pose with OpenCV axes from the camera-to-world pose with OpenGL axes."""
    try:
        pose = np.array(entry["transform_matrix"], np.float64)
    except (KeyError, ValueError, TypeError) as error:
        raise UserError(f"Frame {number} of {path} has no transform_matrix of numbers.") from error
    if pose.shape not in ((4, 4), (3, 4)):
        raise UserError(f"Frame {number} of {path}: transform_matrix must be 4x4, got shape {pose.shape}.")
    if not np.isfinite(pose).all():
        raise UserError(f"Frame {number} of {path}: transform_matrix holds a NaN or an infinity.")
    pose = np.vstack([pose[:3], [0, 0, 0, 1]])
    if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3) or np.linalg.det(pose[:3, :3]) < 0:
        raise UserError(f"Frame {number} of {path}: transform_matrix is no rotation with a translation.")
    return np.asarray(np.linalg.inv(pose @ _OPENGL_TO_OPENCV), np.float64)


def _lens(entry: dict[str, Any], content: dict[str, Any], path: Path, number: int, image: Path | None) -> Lens:
    """Intrinsics of a frame, its own or the file's."""
    stated = {**content, **{key: value for key, value in entry.items() if value is not None}}
    width, height = stated.get("w"), stated.get("h")
    if (width is None or height is None) and image is not None:
        height, width = read_image(image).shape[:2]
    if width is None or height is None:
        raise UserError(f"Frame {number} of {path} has no image size (w, h).")
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
        raise UserError(f"Frame {number} of {path} has no focal length (fl_x, fl_y).") from error
    except (TypeError, ValueError) as error:
        raise UserError(f"Frame {number} of {path} has intrinsics that are no numbers: {error}.") from error
    model = str(stated.get("camera_model", "OPENCV"))
    if model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return Lens("PINHOLE", pinhole, *size)
    if model == "OPENCV" and coefficients["k3"] != 0:
        model = "FULL_OPENCV"
    if model not in _DISTORTION:
        known = ", ".join(("PINHOLE", *_DISTORTION))
        raise UserError(f"Frame {number} of {path} has the camera model {model!r}; known are {known}.")
    distortion = tuple(coefficients[key] for key in _DISTORTION[model])
    if not any(distortion) and model != "OPENCV_FISHEYE":
        return Lens("PINHOLE", pinhole, *size)
    return Lens(model, pinhole + distortion, *size)


def _temperature_bounds(root: Path) -> tuple[float, float] | None:
    path = root / "temperature_bounds.json"
    if not path.is_file():
        return None
    return celsius_range(read_json(path), path, "absolute_min_temperature", "absolute_max_temperature")
