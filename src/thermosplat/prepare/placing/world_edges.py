"""Edges of all photographs in the world, and those of them that a camera elsewhere sees."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2  # noqa: F401  before pycolmap, see datasets/lens.py
import numpy as np
import pycolmap
from numpy.typing import NDArray

from thermosplat.prepare.registration.rig_camera import Array, RigCamera
from thermosplat.prepare.registration.stereo_edges import EdgePoints, photograph_edges

_EDGES_PER_PHOTOGRAPH = 3000
_USUAL_NEIGHBOURS = 6
"""Nearest photographs whose median distance is the unit of distances between cameras."""
PER_RADIAN = 4.0
"""So many of that unit are as far as one radian between the directions of two views. Open choice."""
_BEYOND = 1.5
"""Half diagonals from the axis up to which the lens is believed; farther out a polynomial may fold back."""
_LEAST_WEIGHT = 0.05
"""Edge points of less weight are left out."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where an image was taken.

    Args:
        rotation: World to camera, [3, 3].
        centre: In the world, [3].
    """

    rotation: Array
    centre: Array

    def camera(self, lens: RigCamera) -> RigCamera:
        """The camera with that lens, from the world's axes."""
        return RigCamera(self.rotation, -self.rotation @ self.centre, lens.lens, lens.width, lens.height)

    @classmethod
    def of(cls, camera: RigCamera) -> "Pose":
        """The pose of a camera from the world's axes."""
        return cls(camera.rotation, -camera.rotation.T @ camera.translation)


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs with a pose, and their edges; and those of thermal images that are placed, if there are some.

    Args:
        poses: Of each.
        edges: Edges in the world's axes, in the order of the photographs and then of ``placed``.
        placed: Poses of thermal images by number.
    """

    poses: Sequence[Pose]
    edges: EdgePoints
    placed: Mapping[int, Pose] = field(default_factory=dict)

    def of_placed(self) -> dict[int, slice]:
        """Numbers of the edge points of each placed thermal image."""
        first = len(self.poses)
        bounds = np.searchsorted(self.edges.frame, np.arange(first, first + len(self.placed) + 1))
        return {number: slice(*bounds[k : k + 2]) for k, number in enumerate(self.placed)}

    def near(self, pose: Pose, most: int) -> list[int]:
        """The photographs that look about where a camera looks, from near it, the nearest first; then thermal images.

        Args:
            pose: The camera's.
            most: How many of each.
        """
        count, others = len(self.poses), [*self.poses, *self.placed.values()]
        axes = np.array([other.rotation[2] for other in others])
        angle = np.arccos(np.clip(axes @ pose.rotation[2], -1, 1))
        apart = np.linalg.norm([other.centre - pose.centre for other in others], axis=1)
        usual = np.median(np.sort(apart[:count])[:_USUAL_NEIGHBOURS]) + 1e-9
        order = np.argsort(apart / usual + PER_RADIAN * angle)
        return [int(number) for number in (*order[order < count][:most], *order[order >= count][:most])]

    def before(self, camera: RigCamera, photographs: Sequence[int], weights: Array | None = None) -> NDArray[np.int64]:
        """Numbers of the edge points of some photographs that lie before a camera and not far aside.

        Args:
            camera: The camera, from the world's axes.
            photographs: Which photographs.
            weights: How much each edge point counts; next to nothing leaves it out. None: all count.
        """
        bounds = np.searchsorted(self.edges.frame, np.array([photographs, np.add(photographs, 1)]))
        chosen = np.concatenate([np.arange(first, last) for first, last in bounds.T])
        if weights is not None:
            chosen = chosen[weights[chosen] > _LEAST_WEIGHT]
        local = self.edges.points[chosen] @ camera.rotation.T + camera.translation
        reach = _BEYOND * np.hypot(camera.width, camera.height) / 2 / camera.lens[0]
        return chosen[np.hypot(local[:, 0], local[:, 1]) < reach * local[:, 2]]

    def some(self, numbers: NDArray[np.int64]) -> EdgePoints:
        """These edge points, as of one frame 0."""
        return EdgePoints(np.zeros(len(numbers), np.int64), self.edges.points[numbers], self.edges.along[numbers])


def photographs_of(
    model: pycolmap.Reconstruction, images: Sequence[pycolmap.Image], folder: Path, width: int
) -> Photographs:
    """Photographs of a model, and their edges.

    Args:
        model: COLMAP model with points.
        images: Its photographs.
        folder: Folder that their names are relative to.
        width: They are used at about this width [px].
    """
    poses = [Pose(image.cam_from_world().rotation.matrix(), image.projection_center()) for image in images]
    local = photograph_edges(model, images, folder, width, _EDGES_PER_PHOTOGRAPH)
    rotations = np.array([pose.rotation for pose in poses])[local.frame]
    centres = np.array([pose.centre for pose in poses])[local.frame]
    points, along = (np.einsum("nji,nj->ni", rotations, towards) + centres for towards in (local.points, local.along))
    return Photographs(poses, EdgePoints(local.frame, points, along))
