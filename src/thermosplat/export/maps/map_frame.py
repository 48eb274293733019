"""The frame of a map: where east, north and up are in the world of a capture, and what part of it the map shows."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError

Vector = NDArray[np.float64]

_LOOKING_DOWN = 0.8
"""Mean of unit viewing directions this long: all cameras look about one way, as those of a flight over a field do."""
_BOUNDS_PERCENTILES = (1.0, 99.0)
"""Of the sparse points along each axis; what lies outside are mostly outliers."""
_MARGIN = 0.02
"""Of the extent, on each side."""


@dataclass(frozen=True)
class MapFrame:
    """A similarity from the scene's frame to a map: ``scale * rotation @ x + offset``.

    Map coordinates are east, north and up; metres where the map is georeferenced, world units otherwise.
    """

    rotation: Vector
    """[3, 3]; its rows are the directions of east, north and up in the scene."""
    scale: float = 1.0
    """Map units per unit of the scene."""
    offset: Vector | None = None
    """Map coordinates of the scene's origin, [3]; None: zero."""
    crs: str | None = None
    """The map's coordinate system, such as "EPSG:32632"; None: local coordinates."""
    note: str = ""
    """How the frame was found, in a sentence."""

    @classmethod
    def of_similarity(cls, matrix: Vector, crs: str | None = None) -> "MapFrame":
        """The frame of a similarity [3, 4] from the scene to the map."""
        scale = float(np.cbrt(np.linalg.det(matrix[:, :3])))
        return cls(matrix[:, :3] / scale, scale, matrix[:, 3], crs)

    def to_map(self, points: NDArray[np.floating]) -> Vector:
        """Map coordinates of the scene's points, both [..., 3]."""
        mapped = self.scale * (np.asarray(points, np.float64) @ self.rotation.T)
        return mapped if self.offset is None else mapped + self.offset

    def to_scene(self, points: NDArray[np.floating]) -> Vector:
        """The scene's coordinates of map points, both [..., 3]."""
        centred = np.asarray(points, np.float64)
        if self.offset is not None:
            centred = centred - self.offset
        return centred @ self.rotation / self.scale

    @property
    def inverse(self) -> "MapFrame":
        """From the map to the scene, as if the map were a scene and the scene its map."""
        return MapFrame(self.rotation.T, 1 / self.scale, self.to_scene(np.zeros(3)))

    def viewmat_to_scene(self, viewmat: NDArray[np.floating]) -> Vector:
        """A camera of the map as one of the scene, both [4, 4]: the same picture, with depths divided by ``scale``."""
        there = np.eye(4)
        offset = np.zeros(3) if self.offset is None else self.offset
        there[:3, :3] = viewmat[:3, :3] @ self.rotation
        there[:3, 3] = (viewmat[:3, :3] @ offset + viewmat[:3, 3]) / self.scale
        return there

    def of(self, inner: "MapFrame") -> "MapFrame":
        """The map frame of another scene.

        Args:
            inner: From that scene to the one that this frame is of.
        """
        offset = np.zeros(3) if inner.offset is None else inner.offset
        return replace(
            self, rotation=self.rotation @ inner.rotation, scale=self.scale * inner.scale, offset=self.to_map(offset)
        )


def leading_spectrum(capture: Capture) -> str:
    """The first spectrum with training views: its cameras say where the ground is."""
    return next(name for name in capture.spectra if any(name in frame.views for frame in capture.train))


def camera_centers(capture: Capture, spectrum: str) -> tuple[Vector, Vector]:
    """Centres [V, 3] and viewing directions [V, 3] of a spectrum's training cameras, in the scene's frame.

    Raises:
        UserError: It has no training views.
    """
    viewmats = [frame.views[spectrum].viewmat for frame in capture.train if spectrum in frame.views]
    if not viewmats:
        raise UserError(f"{capture.name} has no training views of {spectrum} to find the ground by.")
    poses = np.linalg.inv(np.stack(viewmats))
    return poses[:, :3, 3], poses[:, :3, 2]


def local_frame(capture: Capture, spectrum: str, up: tuple[float, float, float] | None = None) -> MapFrame:
    """A map frame in world units, from the cameras alone.

    Cameras that all look one way look down. Others are held upright: up is the mean of what is up in their images.

    Args:
        up: What is up in the world; None: found by the cameras.

    Raises:
        UserError: ``up`` is zero, or there are no training views.
    """
    if up is not None:
        if not np.isfinite(up).all() or np.linalg.norm(up) == 0:
            raise UserError(f"--up must be a direction, found {' '.join(f'{x:g}' for x in up)}.", "Give --up 0 0 1.")
        return _local(capture, np.array(up), "Up is as given.")
    _, directions = camera_centers(capture, spectrum)
    mean = directions.mean(axis=0)
    if np.linalg.norm(mean) > _LOOKING_DOWN:
        return _local(capture, -mean, "Down is where the cameras look: all look about one way.")
    viewmats = np.stack([frame.views[spectrum].viewmat for frame in capture.train if spectrum in frame.views])
    return _local(capture, -viewmats[:, 1, :3].mean(axis=0), "Up is what is up in the cameras' images.")


def _local(capture: Capture, up: Vector, note: str) -> MapFrame:
    """The frame in world units in which a direction is up."""
    rotation, placement = _with_up(up), capture.placement
    offset = rotation @ placement.origin if placement.is_moved else None
    return MapFrame(rotation, placement.unit, offset, note=note)


def _with_up(up: Vector) -> Vector:
    """A rotation whose last row is a direction, and whose first is as near to the world's x as can be."""
    up = up / np.linalg.norm(up)
    x = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    east = x - (x @ up) * up
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def map_extent(frame: MapFrame, capture: Capture) -> tuple[float, float, float, float]:
    """West, south, east and north of what the capture saw: its sparse points without outliers, and a margin."""
    return tuple(np.concatenate(_bounds(frame.to_map(capture.points)[:, :2])).tolist())


def scene_bounds(capture: Capture) -> tuple[Vector, Vector]:
    """Lowest and highest world coordinates [3] of what the capture saw: its sparse points without outliers."""
    return _bounds(capture.placement.to_world(capture.points))


def _bounds(points: Vector) -> tuple[Vector, Vector]:
    low, high = np.percentile(points, _BOUNDS_PERCENTILES, axis=0)
    margin = _MARGIN * (high - low)
    return low - margin, high + margin
