"""Starting points for captures with a transforms file: its point cloud, a COLMAP model beside it, or random ones."""

import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.values import shown
from thermosplat.datasets.cameras import camera_center
from thermosplat.datasets.colmap.model import ColmapModel, read_model
from thermosplat.datasets.frame_files import FrameFiles, Shot
from thermosplat.datasets.images.image_names import stem_key
from thermosplat.datasets.random_points import MIN_POINTS, STARTING_RANDOM, random_points, starting_places
from thermosplat.datasets.transforms.point_cloud import read_point_cloud
from thermosplat.errors import UserError

_AGREEMENT = 0.02
"""Share of the cameras' spread by which COLMAP's camera positions may differ for its points to be used."""

Points = tuple[NDArray[np.float64], NDArray[np.uint8]]


def transforms_points(
    root: Path, file: str, content: dict[str, Any], frames: Sequence[FrameFiles], model_folder: Path | None
) -> tuple[NDArray[np.float64], NDArray[np.uint8], list[str]]:
    """Points [M, 3], colours [M, 3] uint8, and notes.

    Args:
        model_folder: A COLMAP model beside it, or None.
    """
    stated = content.get("ply_file_path")
    if stated is not None and not isinstance(stated, str):
        raise UserError(
            f"ply_file_path of {root / file} must be a file name, found {shown(stated)}.",
            "Correct it, or remove it.",
        )
    notes: list[str] = []
    for name in dict.fromkeys((stated or "sparse_pc.ply", "sparse_pc.ply")):
        if os.path.isfile(root / name):  # False also for a name that is too long
            return *_ply_points(root / name), notes
        if name == stated:
            notes.append(f"ply_file_path of {file} is {stated}, which does not exist.")
    if model_folder is not None:
        applied = _applied(content, root / file)
        model = read_model(model_folder)
        points = model.points @ applied[:, :3].T + applied[:, 3]
        reason = "has other poses"
        if starting_places(points) < MIN_POINTS:
            where = "" if len(points) < MIN_POINTS else f" in fewer than {MIN_POINTS} places"
            reason = f"has {len(points):,} points{where}"
        elif _same_world(model, applied, frames, root):
            return points, model.point_colors, notes
        notes.append(f"The COLMAP model beside {file} {reason}: it is not used.")
    notes.append(f"No point cloud (ply_file_path, sparse_pc.ply or a COLMAP model): {STARTING_RANDOM}")
    return *random_points(_centers(frames)), notes


def _ply_points(path: Path) -> Points:
    points, colors = read_point_cloud(path)
    places = starting_places(points)
    if places < MIN_POINTS:
        where = "" if len(points) < MIN_POINTS else f" in {places} places"
        raise UserError(
            f"{path} holds {len(points):,} points{where}; at least {MIN_POINTS} are needed.",
            "Remove it to start from random points around the cameras.",
        )
    return points, colors


def _applied(content: dict[str, Any], path: Path) -> NDArray[np.float64]:
    """The map [3, 4] from COLMAP's world to the file's (nerfstudio's applied_transform)."""
    stated = content.get("applied_transform", np.eye(4)[:3])
    try:
        applied = np.array(stated, np.float64)
    except (ValueError, TypeError, OverflowError):
        applied = np.empty(0)
    if applied.shape not in ((3, 4), (4, 4)):
        raise UserError(
            f"applied_transform of {path} must be a 3x4 matrix of numbers, found {shown(stated)}.",
            "Correct it, or remove it if the poses are those of the COLMAP model.",
        )
    return applied[:3]


def _same_world(model: ColmapModel, applied: NDArray[np.float64], frames: Sequence[FrameFiles], root: Path) -> bool:
    """COLMAP's camera positions, mapped, are those of the frames of the same path or else of the same stem."""
    placed = [(image.name, camera_center(image.viewmat)) for image in model.images]
    positions = {name.stem: center for name, center in placed} | {stem_key(name): center for name, center in placed}
    pairs = [
        (positions[key], camera_center(shot.viewmat))
        for shot in _shots(frames)
        if (key := next((key for key in _keys(shot.path, root) if key in positions), None)) is not None
    ]
    if not pairs:
        return False
    theirs, ours = np.array(pairs).transpose(1, 0, 2)
    mapped = theirs @ applied[:, :3].T + applied[:, 3]
    spread = max(float(np.ptp(_centers(frames), axis=0).max()), 1e-6)
    return float(np.median(np.linalg.norm(mapped - ours, axis=1))) <= _AGREEMENT * spread


def _keys(path: Path, root: Path) -> tuple[str, str]:
    """What the image of a frame may be called in the model."""
    name = PurePosixPath(path.relative_to(root) if path.is_relative_to(root) else path.name)
    return stem_key(name), name.stem


def _shots(frames: Sequence[FrameFiles]) -> list[Shot]:
    return [frame.shots[frame.leading] for frame in frames]


def _centers(frames: Sequence[FrameFiles]) -> NDArray[np.float64]:
    return np.array([camera_center(shot.viewmat) for shot in _shots(frames)])
