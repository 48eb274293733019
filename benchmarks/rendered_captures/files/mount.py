"""Two cameras that move through a scene, and in what a capture of theirs may differ from the published one."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rendered_captures.scene_builder import Builder
from rendered_captures.sensors.lens import Lens

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Variant:
    """In what a capture differs from the published one."""

    views: int | None = None
    """Photographs; None: as published."""
    samples: int | None = None
    """Per pixel; None: as published."""
    seed: int | None = None
    size_factor: float = 1.0
    """Of both images' width and height."""
    unpaired: bool = False
    """Thermal images are taken between the photographs, not with them."""
    drift: float | None = None
    """Span of the thermal camera's levels [K]; None: as published."""
    jump_every: int | None = None
    """Frames between two closings of its shutter; None: as published."""
    electrons: float | None = None
    """At white of photographs in the dark; None: by day."""
    readout: float = 0.0
    """Time from the first line of a thermal image to its last, as a share of the time between frames; 0: at once."""


@dataclass(frozen=True)
class Mount:
    """Two cameras that move through a scene."""

    scene: Builder
    poses: list[Array]
    """Of the photographs: camera to world in Mitsuba's axes, each [4, 4]."""
    visible: Lens
    thermal: Lens
    turn: tuple[float, float, float]
    """Of the thermal camera in the photographic one's axes, a rotation vector [degrees]."""
    offset: tuple[float, float, float]
    """Where it is there [m]."""
    photographs: list[str]
    thermal_images: list[str]
    """Names of the files."""
    samples: tuple[int, int]
    """Per pixel of photographs and thermal images."""
    seeds: tuple[int, ...]
    """The first is that of the renders."""
    jpeg: int
    """Quality."""
    metered: int | None = None
    """Which photograph sets the exposure of all; None: all do."""
    drift: float | None = 0.0
    jump_every: int = 0
    exif: dict[str, bytes] = field(default_factory=dict)
    """By photograph."""

    def rng(self, *key: int) -> np.random.Generator:
        """Chance for one purpose."""
        return np.random.default_rng([*self.seeds, *key])
