"""Where the scene that is trained lies in the world, the frame of a capture's own poses.

A scene has float32 coordinates and a near plane of 0.01. At UTM coordinates neighbouring numbers of float32 are half a
metre apart, and of a world that is measured in kilometres everything lies before the near plane. Such captures are
moved and scaled when they are read:

    world = origin + unit · scene

Everything inside is in the scene's frame: poses and points of a :class:`~thermosplat.datasets.capture.Capture`,
Gaussians, depths. Everything that leaves is in the world's. Captures in usual coordinates have the world's frame.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_REACH = 0.1
"""Least distance from the cameras to what is nearest to them [world units] of a scene whose unit stays: the near plane
is a tenth of it. Open choice."""
LARGEST_SIZE = 1e6
"""Size of the largest scene whose unit stays [world units]: a square kilometre in millimetres."""
USUAL_REACH = 1.0
"""What that distance is brought to in others, within a factor of 1.42: the near plane is about 1% of it. It is 0.9 in
the sample, and 1 to 15 in captures whose poses are COLMAP's."""
_NEAREST = 10
"""Points that may lie nearer: structure-from-motion leaves some before the cameras."""
_CAMERAS = 32
"""From so many cameras, evenly chosen, points are looked at."""
_SIZES, _NUMBERS = (1e-24, 1e24), (1e-31, 1e31)
"""Sizes beyond which nothing is a scene, and the numbers that follow from them."""
FARTHEST_ORIGIN = 16.0
"""Sizes of the scene beyond which it is moved to the origin. There float32 has steps of 1e-6 sizes: the least by which
means are learnt (``means_lr_final`` of 3DGS)."""


@dataclass(frozen=True)
class Placement:
    """A scene's frame: ``world = origin + unit · scene``. It is not turned."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the scene's origin is in the world [world units]."""
    unit: float = 1.0
    """World units of a unit of the scene, > 0: a power of two, which rounds no number."""

    @classmethod
    def of(cls, centers: Array, points: Array) -> "Placement":
        """The frame of a scene: the world's, wherever float32 and the near plane are good enough there.

        Args:
            centers: Places of cameras in the world, [N, 3], N >= 1.
            points: Sparse points in the world, [M, 3]; those that are not finite do not count.
        """
        middle = np.median(centers, axis=0)
        known = points[np.isfinite(points).all(axis=-1)]
        with np.errstate(over="ignore"):  # an outlier at 1e300
            spreads = [np.linalg.norm(places - middle, axis=1) for places in (centers, known)]
            nearest = _reach(centers, known)
        size = max(float(np.median(spread)) for spread in spreads if len(spread))
        if not _SIZES[0] < size < _SIZES[1]:
            return cls()
        reach = max(nearest, size / LARGEST_SIZE)
        usual = reach >= LEAST_REACH and size <= LARGEST_SIZE
        unit = 1.0 if usual else 2.0 ** round(math.log2(reach / USUAL_REACH))
        if np.linalg.norm(middle) <= FARTHEST_ORIGIN * size:
            return cls(unit=unit)
        digits = -math.floor(math.log10(size))
        x, y, z = (round(float(coordinate), digits) for coordinate in middle)  # a number that people can subtract
        return cls((x, y, z), unit)

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Placement":
        """The inverse of ``state``; of {}, which old checkpoints have, the world's own frame.

        Raises:
            ValueError, TypeError: It is something else.
        """
        x, y, z = (float(coordinate) for coordinate in state.get("origin", (0.0, 0.0, 0.0)))
        unit = float(state.get("unit", 1.0))
        if not (abs(x) + abs(y) + abs(z) < _NUMBERS[1] and _NUMBERS[0] < unit < _NUMBERS[1]):
            raise ValueError(f"no frame has the origin {x:g} {y:g} {z:g} and the unit {unit:g}")
        return cls((x, y, z), unit)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"origin": list(self.origin), "unit": self.unit}

    @property
    def is_moved(self) -> bool:
        """Whether the scene's origin is not the world's."""
        return self.origin != (0.0, 0.0, 0.0)

    def to_scene(self, points: NDArray[np.floating]) -> Array:
        """World points in the scene's frame, both [..., 3]."""
        return (np.asarray(points, np.float64) - self.origin) / self.unit

    def to_world(self, points: NDArray[np.floating]) -> Array:
        """Points of the scene in the world, both [..., 3]."""
        return self.unit * np.asarray(points, np.float64) + self.origin

    def viewmat_to_scene(self, viewmat: NDArray[np.floating]) -> Array:
        """From the matrices that take world points to camera axes, [..., 4, 4], those that take the scene's points."""
        moved = np.array(viewmat, np.float64)
        moved[..., :3, 3] = (moved[..., :3, :3] @ self.origin + moved[..., :3, 3]) / self.unit
        return moved

    def viewmat_to_world(self, viewmat: NDArray[np.floating]) -> Array:
        """The inverse of ``viewmat_to_scene``."""
        moved = np.array(viewmat, np.float64)
        moved[..., :3, 3] = self.unit * moved[..., :3, 3] - moved[..., :3, :3] @ self.origin
        return moved

    def note(self) -> list[str]:
        """What to tell people of it, in one sentence or none."""
        if self == WORLD:
            return []
        origin = " ".join(f"{coordinate:.12g}" for coordinate in self.origin)
        how = [f"from {origin}"] if self.is_moved else []
        how += [f"in units of {self.unit:.6g}"] if self.unit != 1.0 else []
        counted = f"Inside, coordinates are counted {' and '.join(how)}, which suits float32 and the near plane."
        splats = ", and splats lie relative to that origin (geo.json)" if self.is_moved else ""
        return [f"{counted} Files have the capture's own{splats}."]


WORLD = Placement()
"""The world's own frame."""


def _reach(centers: Array, points: Array) -> float:
    """How near points come to cameras: the median over cameras of the distance of the tenth point; 0 without points."""
    if not len(points):
        return 0.0
    tenth = min(_NEAREST, len(points)) - 1
    chosen = centers[:: -(-len(centers) // _CAMERAS)]
    distances = (np.linalg.norm(points - center, axis=1) for center in chosen)
    return float(np.median([np.partition(distance, tenth)[tenth] for distance in distances]))
