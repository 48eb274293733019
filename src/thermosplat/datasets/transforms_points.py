"""Starting points for captures with a transforms file: its point cloud, a COLMAP model beside it, or random ones."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.cameras import camera_center
from thermosplat.datasets.colmap_model import ColmapModel, read_model
from thermosplat.datasets.frame_files import FrameFiles
from thermosplat.errors import UserError

_RANDOM_POINTS = 50_000
"""As many as nerfstudio's splatfacto starts with."""
_RANDOM_RADIUS = 3.0
"""Half the side of the box of random points, in camera-to-centre distances (gsplat's trainer: init_extent 3)."""
_AGREEMENT = 0.02
"""Share of the cameras' spread by which COLMAP's camera positions may differ for its points to be used."""

Points = tuple[NDArray[np.float32], NDArray[np.uint8]]


def transforms_points(
    root: Path, content: dict[str, Any], frames: Sequence[FrameFiles], model_folder: Path | None
) -> tuple[NDArray[np.float32], NDArray[np.uint8], list[str]]:
    """Points [M, 3], colours [M, 3] uint8, and notes.

    Args:
        root: The capture's folder.
        content: The transforms file.
        frames: Its frames.
        model_folder: A COLMAP model beside it, or None.
    """
    for name in (content.get("ply_file_path"), "sparse_pc.ply"):
        if name and (root / name).is_file():
            return *_ply_points(root / name), []
    notes = []
    if model_folder is not None:
        model = read_model(model_folder)
        points = (model.points @ _applied(content)[:, :3].T + _applied(content)[:, 3]).astype(np.float32)
        if len(points) >= 4 and _same_world(model, _applied(content), frames):
            return points, model.point_colors, []
        notes.append("The COLMAP model beside the transforms file has other poses; its points were not used.")
    points, colors = _random_points(_centers(frames))
    notes.append(
        "No point cloud (ply_file_path, sparse_pc.ply or a COLMAP model): "
        f"starting from {_RANDOM_POINTS:,} random points around the cameras."
    )
    return points, colors, notes


def _ply_points(path: Path) -> Points:
    model = pycolmap.Reconstruction()
    try:
        model.import_PLY(path)
    except (ValueError, RuntimeError, IndexError) as error:
        raise UserError(
            f"{path} is not a readable point cloud.", "Expected a PLY with x, y, z, red, green, blue."
        ) from error
    points = list(model.points3D.values())
    if len(points) < 4:
        raise UserError(f"{path} holds {len(points)} points; at least 4 are needed.")
    return np.array([p.xyz for p in points], np.float32), np.array([p.color for p in points], np.uint8)


def _applied(content: dict[str, Any]) -> NDArray[np.float64]:
    """The map [3, 4] from COLMAP's world to the file's (nerfstudio's applied_transform)."""
    return np.array(content.get("applied_transform", np.eye(4)[:3]), np.float64)[:3]


def _same_world(model: ColmapModel, applied: NDArray[np.float64], frames: Sequence[FrameFiles]) -> bool:
    """COLMAP's camera positions, mapped, are those of the frames of the same stem."""
    positions = {image.name.stem: camera_center(image.viewmat) for image in model.images}
    names = [index for index, frame in enumerate(frames) if frame.name in positions]
    if not names:
        return False
    centers = _centers(frames)
    mapped = np.array([applied[:, :3] @ positions[frames[i].name] + applied[:, 3] for i in names])
    spread = max(float(np.ptp(centers, axis=0).max()), 1e-6)
    return float(np.median(np.linalg.norm(mapped - centers[names], axis=1))) <= _AGREEMENT * spread


def _centers(frames: Sequence[FrameFiles]) -> NDArray[np.float64]:
    shots = [frame.rgb or frame.thermal for frame in frames]
    return np.array([camera_center(shot.viewmat) for shot in shots if shot is not None])


def _random_points(centers: NDArray[np.float64]) -> Points:
    """Uniform points of random colours in a cube around the cameras, the same ones every time."""
    mean = centers.mean(0)
    radius = max(1.1 * float(np.linalg.norm(centers - mean, axis=1).max()), 1e-3) * _RANDOM_RADIUS
    generator = np.random.default_rng(0)
    points = mean + generator.uniform(-radius, radius, (_RANDOM_POINTS, 3))
    return points.astype(np.float32), generator.integers(0, 256, (_RANDOM_POINTS, 3), np.uint8)
