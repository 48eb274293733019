"""Lenses and the pose between two cameras from boards that both have seen at once.

Each lens is OpenCV's pinhole with two radial terms and one focal length (COLMAP's RADIAL), from all its boards. Then
all views of both cameras are adjusted together. A checkerboard looks the same after half a turn, all the more when the
warm squares are the dark ones: each pair takes the order of corners that agrees with the other pairs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.lens import Lens
from thermosplat.prepare.calibration.boards import Board, SeenBoard
from thermosplat.prepare.calibration.calibration_file import RigCalibration

Array = NDArray[np.float64]
_LENS_FLAGS = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
_EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)
_AGREES = 10.0
"""Rotations between the cameras that differ by less [°] are the same, before they are adjusted."""


@dataclass(frozen=True, eq=False)
class SeenPair:
    """One exposure of the board."""

    name: str
    rgb: SeenBoard
    thermal: SeenBoard


@dataclass(frozen=True, eq=False)
class BoardCalibration:
    """The rig, and how well it explains the boards.

    Args:
        errors: [N, 2] root mean square reprojection error of each pair in photograph and thermal image [px].
    """

    rig: RigCalibration
    errors: Array


def calibrate_rig(
    pairs: Sequence[SeenPair], board: Board, rgb_size: tuple[int, int], thermal_size: tuple[int, int]
) -> BoardCalibration:
    """Lenses and pose that fit all pairs best.

    Args:
        rgb_size: Width and height of the photographs [px].
        thermal_size: Width and height of the thermal images [px].
    """
    points = board.points()
    sides = [([pair.rgb for pair in pairs], rgb_size), ([pair.thermal for pair in pairs], thermal_size)]
    cameras = [_lens(seen, points, size) for seen, size in sides]
    thermal = _ordered_alike(pairs, points, cameras)
    shared = [_shared(pair.rgb, other) for pair, other in zip(pairs, thermal)]
    objects = [points[ids] for ids, _, _ in shared]
    (k1, d1), (k2, d2) = cameras
    _, k1, d1, k2, d2, rotation, translation, _, _, _, _, errors = cv2.stereoCalibrateExtended(
        objects,
        [one for _, one, _ in shared],
        [other for _, _, other in shared],
        k1,
        d1,
        k2,
        d2,
        rgb_size,
        np.eye(3),
        np.zeros((3, 1)),
        flags=_LENS_FLAGS | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=_EXACT,
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.ravel(translation)
    rig = RigCalibration(_as_lens(k1, d1, rgb_size), _as_lens(k2, d2, thermal_size), pose)
    return BoardCalibration(rig, np.asarray(errors).reshape(-1, 2))


def _lens(seen: Sequence[SeenBoard], points: NDArray[np.float32], size: tuple[int, int]) -> tuple[Array, Array]:
    """Camera matrix and distortion of one camera."""
    guess = np.array([[1.2 * size[0], 0, size[0] / 2], [0, 1.2 * size[0], size[1] / 2], [0, 0, 1.0]])
    _, matrix, distortion, _, _ = cv2.calibrateCamera(
        [points[board.ids] for board in seen],
        [board.pixels for board in seen],
        size,
        guess,
        np.zeros(5),
        flags=_LENS_FLAGS | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=_EXACT,
    )
    return matrix, distortion


def _as_lens(matrix: Array, distortion: Array, size: tuple[int, int]) -> Lens:
    k1, k2 = np.ravel(distortion)[:2]
    params = (matrix[0, 0], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5, k1, k2)
    return Lens("RADIAL", tuple(float(value) for value in params), *size)


def _pose(board: SeenBoard, points: NDArray[np.float32], camera: tuple[Array, Array]) -> Array:
    """[4, 4] the board's points to the camera."""
    _, turn, shift = cv2.solvePnP(points[board.ids], board.pixels, *camera)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    return pose


def _ordered_alike(
    pairs: Sequence[SeenPair], points: NDArray[np.float32], cameras: Sequence[tuple[Array, Array]]
) -> list[SeenBoard]:
    """The thermal boards, each in the order of corners with which the cameras' pose agrees with the other pairs."""
    candidates: list[list[tuple[SeenBoard, Array]]] = []
    for pair in pairs:
        to_board = np.linalg.inv(_pose(pair.rgb, points, cameras[0]))
        orders = [pair.thermal, SeenBoard(pair.thermal.ids, pair.thermal.pixels[::-1].copy())]
        whole = len(pair.thermal.ids) == len(points)
        candidates.append([(seen, _pose(seen, points, cameras[1]) @ to_board) for seen in orders[: 1 + whole]])
    every = [pose for options in candidates for _, pose in options]
    votes = [sum(min(_angle(pose, mine) for _, mine in options) < _AGREES for options in candidates) for pose in every]
    spread = [
        sum(min(float(np.linalg.norm(pose - mine)) for _, mine in options) for options in candidates) for pose in every
    ]
    best = every[min(range(len(every)), key=lambda number: (-votes[number], spread[number]))]
    return [min(options, key=lambda option: _angle(best, option[1]))[0] for options in candidates]


def _angle(one: Array, other: Array) -> float:
    """Angle [°] between the rotations of two poses."""
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(one[:3, :3] @ other[:3, :3].T)[0])))


def _shared(rgb: SeenBoard, thermal: SeenBoard) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Points that both images show, and where."""
    ids, one, other = np.intersect1d(rgb.ids, thermal.ids, return_indices=True)
    return ids, rgb.pixels[one], thermal.pixels[other]
