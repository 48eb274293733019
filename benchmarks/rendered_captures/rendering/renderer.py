"""One loaded scene, rendered from many poses without compiling its kernels again."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_POSE = "sensor.to_world"


class Renderer:
    """A scene and its camera.

    Args:
        scene: As ``band_scenes`` makes it.
        size: Width and height of its images.
        integrator: In place of the scene's own.
    """

    def __init__(self, scene: Any, size: tuple[int, int], integrator: Any = None) -> None:
        self.scene, self.size, self.integrator = scene, size, integrator or scene.integrator()
        self._params = mi.traverse(scene)
        self._key = next(key for key in self._params.keys() if key.endswith(_POSE))  # noqa: SIM118  (no mapping)

    def image(self, pose: Array, samples: int, seed: int) -> NDArray[np.float32]:
        """Radiance, [H, W, 3].

        Args:
            pose: Camera to world in Mitsuba's axes, [4, 4].
            samples: Per pixel.
            seed: Of their places.
        """
        self._place(pose)
        image = mi.render(self.scene, integrator=self.integrator, spp=samples, seed=seed)
        return np.array(image)[..., :3].astype(np.float32)

    def first_hit(self, pose: Array) -> tuple[NDArray[np.float32], NDArray[Any]]:
        """z-depths [m] and numbers of shapes at the pixels' centres, each [H, W]; depth 0 where nothing is hit."""
        self._place(pose)
        width, height = self.size
        pixel = dr.arange(mi.UInt32, width * height)
        place = mi.Point2f((mi.Float(pixel % width) + 0.5) / width, (mi.Float(pixel // width) + 0.5) / height)
        ray, _ = self.scene.sensors()[0].sample_ray(0.0, 0.5, place, mi.Point2f(0.5, 0.5))
        hit = self.scene.ray_intersect(ray)
        places = np.array(hit.p).reshape(3, -1)
        depths = np.where(np.array(hit.is_valid()), pose[:3, 2] @ (places - pose[:3, 3:4]), 0)
        numbers = np.array(dr.reinterpret_array(mi.UInt32, hit.shape))
        return depths.reshape(height, width).astype(np.float32), numbers.reshape(height, width)

    def numbers(self) -> dict[str, int]:
        """The shapes' numbers by their names."""
        shapes = self.scene.shapes()
        return {s.id(): int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s)))[0]) for s in shapes}

    def _place(self, pose: Array) -> None:
        self._params[self._key] = mi.Transform4f(pose)
        self._params.update()
