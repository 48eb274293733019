"""What refining changed of the cameras, in numbers and as a COLMAP model that other programs read."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.config import OF_FRAMES
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.lens import in_colmaps_words
from thermosplat.refinement.camera_corrections import (
    COEFFICIENTS,
    DISTORTION,
    FOCAL,
    INTRINSICS,
    MOTION,
    POSES,
    RIG,
    CameraCorrections,
)
from thermosplat.runs.atomic_writes import write_text
from thermosplat.spectra import label

_BELIEVED = 1.25
"""Factor of a focal length up to which a camera is believed. Cameras that were 5% off were found to about 1%, or were
lost with a factor of 4.8 (benchmarks/records/refinement.md)."""


def correction_summary(corrections: CameraCorrections) -> dict[str, Any]:
    """How far the cameras moved.

    Returns:
        Of what was refined: "poses", the medians over the frames that move; "rig", "focal_factors" and "distortion" by
        spectrum, each a list of its cameras. Angles in degrees, distances in world units.
    """
    summary: dict[str, Any] = {}
    extent = corrections.scene_extent * corrections.unit
    moves = corrections.pose_basis.flatten(1).any(dim=1)
    if corrections.refined & OF_FRAMES and bool(moves.any()):
        moved = corrections.pose_motions()[moves].detach().cpu().double().numpy()
        summary[POSES] = {
            "median_degrees": float(np.median(_degrees(moved[:, :3]))),
            "median_distance": float(np.median(np.linalg.norm(moved[:, 3:], axis=1)) * extent),
        }
    learnt = corrections.camera_corrections().detach().cpu().double().numpy()

    def by_spectrum(of_camera: Callable[[NDArray[np.float64]], Any], spectra: Sequence[str]) -> dict[str, list[Any]]:
        found: dict[str, list[Any]] = {name: [] for name in spectra}
        for shared, correction in zip(corrections.shared, learnt, strict=True):
            if shared.spectrum in found:
                found[shared.spectrum].append(of_camera(correction))
        return found

    if RIG in corrections.refined:
        summary[RIG] = by_spectrum(
            lambda theta: {
                "degrees": float(_degrees(theta[MOTION][:3])),
                "distance": float(np.linalg.norm(theta[MOTION][3:]) * extent),
            },
            corrections.spectra[1:],
        )
    if INTRINSICS in corrections.refined:
        summary["focal_factors"] = by_spectrum(lambda theta: float(np.exp(theta[FOCAL])), corrections.zoomed)
    if DISTORTION in corrections.refined:
        summary[DISTORTION] = by_spectrum(lambda theta: theta[COEFFICIENTS].tolist(), corrections.spectra)
    return summary


def correction_sentences(summary: dict[str, Any]) -> list[str]:
    """The summary for people, a line for each kind of correction.

    Args:
        summary: What ``correction_summary`` returned.
    """
    lines = []
    if (poses := summary.get(POSES)) is not None:
        lines.append(
            f"Poses of the frames: changed by {poses['median_degrees']:.3f}° and {poses['median_distance']:.4g} world "
            "units in the median."
        )
    for name, motions in summary.get(RIG, {}).items():
        for motion in motions:
            turned, moved = f"{motion['degrees']:.3f}°", f"{motion['distance']:.4g} world units"
            lines.append(f"Rig: {label(name)} turned by {turned} and moved by {moved}.")
    for name, factors in summary.get("focal_factors", {}).items():
        if factors:
            lines.append(f"Focal lengths of {label(name)}: times {', '.join(f'{factor:.4f}' for factor in factors)}.")
        if any(abs(np.log(factor)) > np.log(_BELIEVED) for factor in factors):
            lines.append(
                f"The camera of {label(name)} was probably not found: no calibration is so far off. "
                "Train with another --seed, or find it with thermosplat-prepare."
            )
    for name, found in summary.get(DISTORTION, {}).items():
        if found:
            listed = ", ".join(f"k1 {k1:+.4f} k2 {k2:+.4f}" for k1, k2 in found)
            lines.append(f"Distortion left in {label(name)}: {listed}.")
    return lines


def write_cameras(capture: Capture, folder: Path) -> None:
    """Write a capture's cameras as a COLMAP model without points, of the images that were trained on.

    Args:
        capture: The capture; its frames of both splits are written.
        folder: Where to; made.
    """
    numbers: dict[Camera, int] = {}
    images = []
    views = [view for frame in (*capture.train, *capture.test) for view in frame.views.values()]
    for image_id, view in enumerate(views, start=1):
        camera_id = numbers.setdefault(view.camera, len(numbers) + 1)
        x, y, z, w = pycolmap.Rotation3d(view.viewmat[:3, :3]).quat
        translation = capture.placement.viewmat_to_world(view.viewmat)[:3, 3]
        pose = " ".join(repr(float(number)) for number in (w, x, y, z, *translation))
        name = view.path.relative_to(capture.root) if view.path.is_relative_to(capture.root) else Path(view.path.name)
        images.append(f"{image_id} {pose} {camera_id} {name.as_posix()}\n\n")  # no observations
    untouched = any(camera.lens is not None for camera in numbers)
    images_are = "images as they were taken" if untouched else "undistorted images"
    head = f"# Cameras as thermosplat refined them, of the {images_are}. "
    cameras = "".join(f"{number} {_lens(camera)}\n" for camera, number in numbers.items())
    texts = {
        "cameras.txt": f"{head}CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n{cameras}",
        "images.txt": f"{head}IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n{''.join(images)}",
        "points3D.txt": "# No points.\n",
    }
    for file, text in texts.items():
        write_text(folder / file, text)


def _lens(camera: Camera) -> str:
    """A camera in the words of COLMAP: its lens, PINHOLE, or OPENCV where undistorting left some distortion."""
    lens = [camera.fx, camera.fy, camera.cx, camera.cy]
    model = "PINHOLE"
    if camera.lens is not None:
        model, bent = in_colmaps_words(camera.lens)
        lens += bent
    elif camera.distortion is not None:
        model, lens = "OPENCV", [*lens, *camera.distortion, 0.0, 0.0]
    return f"{model} {camera.width} {camera.height} {' '.join(map(repr, lens))}"


def _degrees(r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle of the rotation of the quaternion (1, r / 2) [°], of the last axis."""
    return np.degrees(2.0 * np.arctan(np.linalg.norm(r, axis=-1) / 2.0))
