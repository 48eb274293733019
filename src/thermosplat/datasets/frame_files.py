"""What a layout reader finds in a folder: image files with cameras and poses, before any pixel is read."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.lens import Lens

Split = Literal["train", "test"]


@dataclass(frozen=True, eq=False)
class Shot:
    """One image file with its camera and pose.

    Args:
        path: The file that is seen: a photograph, pseudo-colour, grey, or values where there is nothing else.
        viewmat: [4, 4] float64, world to camera.
        raw: Values of the same exposure, where there are any (may be `path` itself).
        mask: An image that is black where pixels of this one do not count, where there is one.
    """

    path: Path
    lens: Lens
    viewmat: NDArray[np.float64]
    raw: Path | None = None
    mask: Path | None = None

    @property
    def images(self) -> tuple[Path, ...]:
        """The files of `path` and `raw`, each once."""
        return tuple(dict.fromkeys(path for path in (self.path, self.raw) if path is not None))

    @property
    def files(self) -> tuple[Path, ...]:
        """All files, each once."""
        return self.images if self.mask is None else (*self.images, self.mask)


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """The files of one exposure.

    Args:
        name: The frame's name; sorting by it gives the order of the hold-out rule.
        shots: Its images by spectrum, in the order of the spectra; at least one.
        split: What the folder says; None where it says nothing.
        own_cameras: Spectra whose camera the data states; another borrows that of the first image.
    """

    name: str
    shots: Mapping[str, Shot]
    split: Split | None = None
    own_cameras: frozenset[str] = frozenset()

    @property
    def leading(self) -> str:
        """The spectrum of the first image, whose camera others may borrow."""
        return next(iter(self.shots))


@dataclass(frozen=True, eq=False)
class Listing:
    """Everything a layout reader knows of a capture.

    Args:
        frames: The frames, in any order.
        points: [M, 3] float64 [world units].
        point_colors: [M, 3] uint8.
        registered: The layout promises that images without a camera of their own are registered to the first ones at
            whatever resolution; else equal size is taken for the sign.
        celsius_range: Temperatures [°C] of black and white in 8-bit grey thermal images, where stated.
        not_found: By spectrum, the first of the files that the layout names and that do not exist.
    """

    layout: str
    frames: tuple[FrameFiles, ...]
    points: NDArray[np.float64]
    point_colors: NDArray[np.uint8]
    registered: bool = True
    celsius_range: tuple[float, float] | None = None
    not_found: Mapping[str, Path] = field(default_factory=dict)
    notes: tuple[str, ...] = field(default=())
