"""What a camera of a capture truly sees, by the scene that rig_desk or a flight was rendered from.

The capture was prepared: its cameras were estimated, in a world of their own. One similarity takes their places to
those that the photographs were rendered from.
"""

import tempfile
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from rendered_captures.files.mount import Mount, Variant
from rendered_captures.paths import FLIP
from rendered_captures.rendering.band_scenes import thermal_scene
from rendered_captures.rendering.renderer import Renderer
from rendered_captures.scene_builder import LABELS, Object
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.colmap.similarity import similarity_by_weights
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors
from thermosplat.thermography.reprojection import pixel_rays

Array = NDArray[np.float64]
SCENES = ("rig_desk", "flight_a", "flight_b", "flight_c")
_BEHIND = 0.005
"""Share of a distance by which a point may lie behind the first surface and still be seen."""


def mount_of(name: str) -> Mount:
    """The scene and the cameras of one of ``SCENES``, as published."""
    if name == "rig_desk":
        from rendered_captures.files.rig import rig_mount

        return rig_mount(Variant())
    from rendered_captures.files.flight_plan import flight_mount

    return flight_mount(SCENES.index(name) - 1, Variant()).mount


def label_of(thing: Object) -> int:
    """The label of an object's pixels: its own, or that of what mirrors; 0: none."""
    if thing.disc is not None:
        return LABELS[thing.disc]
    return 0 if thing.mirror is None else LABELS["specular"]


def shown_in(points: Array, view: ViewTensors, to_world: Array) -> NDArray[np.bool_]:
    """Which points [P, 3] lie in a pinhole image, hidden or not, [P].

    Args:
        points: In the world of ``to_world`` [m].
        view: The camera.
        to_world: Camera to world, [3, 4].
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # sky has no place
        local = (points - to_world[:, 3]) @ to_world[:, :3]
        place = (local @ view.K.numpy(force=True).T.astype(float))[:, :2] / local[:, 2:]
    inside = ((place >= 0) & (place <= (view.width, view.height))).all(axis=1)
    return np.isfinite(points).all(axis=1) & (local[:, 2] > 0) & inside


class TrueSurfaces:
    """The scene of a capture; Mitsuba is started (``rendering.start``).

    Args:
        name: One of ``SCENES``.
        capture: The prepared capture, in any world.
        spectrum: The thermal one.
    """

    def __init__(self, name: str, capture: Capture, spectrum: str) -> None:
        mount = mount_of(name)
        true = {Path(file).stem: pose @ FLIP for file, pose in zip(mount.photographs, mount.poses, strict=True)}
        photographs = [
            view
            for frame in (*capture.train, *capture.test)
            for view in frame.views.values()
            if Path(view.name).stem in true
        ]
        mine = np.array([np.linalg.inv(view.viewmat)[:3, 3] for view in photographs])
        theirs = np.array([true[Path(view.name).stem][:3, 3] for view in photographs])
        self._similarity = similarity_by_weights(mine, theirs, np.ones(len(mine)))
        self.cameras_off = float(np.linalg.norm(self._moved(mine) - theirs, axis=1).mean())
        """[m]."""
        with tempfile.TemporaryDirectory() as folder:
            size, scene = (8, 8), mount.scene
            everything = Renderer(thermal_scene(scene, size, scene.fov, Path(folder)), size)
            self._all = everything.scene
            self._opaque = thermal_scene(scene, size, scene.fov, Path(folder), lambda thing: thing.tau == 0)
        numbers = everything.numbers()
        self._labels = np.zeros(max(numbers.values()) + 1, np.uint8)
        for thing in scene.objs:
            self._labels[numbers[thing.name]] = label_of(thing)
        frames = [frame for frame in capture.train if spectrum in frame.views]
        self._training = [view_tensors(frame.views[spectrum], None, "cpu") for frame in frames]

    def labels(self, view: ViewTensors) -> NDArray[np.uint8]:
        """Numbers of ``LABELS``, [H, W]; 0 where there is none."""
        _, numbers = _first(self._all, *self._rays(view))
        found: NDArray[np.uint8] = self._labels[numbers].reshape(view.height, view.width)
        return found

    def seen(self, view: ViewTensors) -> NDArray[np.int64]:
        """How many training images show the opaque surface of each pixel, [H, W]."""
        place, rays = self._rays(view)
        points = place + rays * _first(self._opaque, place, rays)[0][:, None]
        found = np.zeros(len(points), np.int64)
        for taken in self._training:
            pose = self._pose(taken)
            shown = np.flatnonzero(shown_in(points, taken, pose))
            lengths, _ = _first(self._opaque, pose[:, 3], points[shown] - pose[:, 3])
            found[shown[lengths > 1 - _BEHIND]] += 1
        return found.reshape(view.height, view.width)

    def _rays(self, view: ViewTensors) -> tuple[Array, Array]:
        """Where a camera is [m], and where its pixels look, [H * W, 3]."""
        pose = self._pose(view)
        return pose[:, 3], pixel_rays(view).numpy(force=True).reshape(-1, 3).astype(float) @ pose[:, :3].T

    def _pose(self, view: ViewTensors) -> Array:
        """Camera to the scene's world, [3, 4]."""
        pose = np.linalg.inv(view.viewmat.numpy(force=True).astype(float))
        turn = self._similarity[:, :3] / np.cbrt(np.linalg.det(self._similarity[:, :3]))
        return np.column_stack([turn @ pose[:3, :3], self._moved(pose[None, :3, 3])[0]])

    def _moved(self, places: Array) -> Array:
        moved: Array = places @ self._similarity[:, :3].T + self._similarity[:, 3]
        return moved


def _first(scene: Any, place: Array, rays: Array) -> tuple[Array, NDArray[np.int64]]:
    """First surfaces along rays [P, 3]: after how many lengths of the ray (inf: none), and their numbers, each [P]."""
    if not len(rays):
        return np.zeros(0), np.zeros(0, np.int64)
    lengths = np.linalg.norm(rays, axis=1)
    along = mi.Vector3f(*(mi.Float(column) for column in np.ascontiguousarray((rays / lengths[:, None]).T, np.float32)))
    origin = mi.Point3f(*(dr.full(mi.Float, float(value), len(rays)) for value in place))
    hit = scene.ray_intersect(mi.Ray3f(origin, along))
    there = np.array(hit.is_valid())
    numbers = np.array(dr.reinterpret_array(mi.UInt32, hit.shape)).astype(np.int64)
    return np.where(there, np.array(hit.t) / lengths, np.inf), np.where(there, numbers, 0)
