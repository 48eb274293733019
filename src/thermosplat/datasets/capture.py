"""A capture in memory: frames of an RGB and a thermal view each, sparse points, and what thermal values mean."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermosplat.cameras import Camera, camera_center
from thermosplat.datasets.image_folders import looked_for_rgb, looked_for_thermal
from thermosplat.errors import UserError
from thermosplat.radiometry import ThermalScale

Modality = Literal["rgb", "thermal"]


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """One image with its camera.

    Args:
        modality: "rgb" or "thermal".
        name: File name without its ending.
        path: The image file.
        camera: Pinhole intrinsics at the size of `image`.
        viewmat: [4, 4] float64, world to camera, OpenCV axes.
        image: uint8 [H, W, 3] for RGB and pseudo-coloured thermal; float32 [H, W, 1] in [0, 1] for scalar thermal.
        celsius: float32 [H, W], measured temperature [°C], where the data has it; thermal views only.
    """

    modality: Modality
    name: str
    path: Path
    camera: Camera
    viewmat: NDArray[np.float64]
    image: NDArray[np.uint8] | NDArray[np.float32]
    celsius: NDArray[np.float32] | None = None

    def __repr__(self) -> str:
        channels = "1 channel" if self.image.shape[2] == 1 else f"{self.image.shape[2]} channels"
        celsius = "" if self.celsius is None else ", with °C"
        size = f"{self.camera.width}x{self.camera.height} px"
        return f"View({self.modality} {self.name!r}, {size}, {channels}{celsius})"


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """One exposure: the RGB and the thermal view that were taken together, or the one there is."""

    name: str
    rgb: View | None
    thermal: View | None

    def __repr__(self) -> str:
        return f"Frame({self.name!r}, {', '.join(map(repr, _views(self))) or 'no views'})"

    @property
    def aligned(self) -> bool:
        """Both views exist and share camera, size and pose, so that one traversal renders both."""
        if self.rgb is None or self.thermal is None:
            return False
        return self.rgb.camera == self.thermal.camera and np.array_equal(self.rgb.viewmat, self.thermal.viewmat)


@dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """Everything training and evaluation take from a folder.

    Args:
        name: The folder's name, or "sample".
        root: The folder.
        layout: "rgbt-scenes", "colmap", "colmap-rig" or "transforms": how the folder was read.
        train: Frames to learn from, by name.
        test: Held-out frames, by name.
        points: [M, 3] float32 sparse points [world units].
        point_colors: [M, 3] uint8.
        thermal_scale: Meaning of the thermal pixel values; None without thermal images.
        notes: What the user should be told once, a line each.
        not_found: By modality, the first of the image files that the capture names and that do not exist.
    """

    name: str
    root: Path
    layout: str
    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    points: NDArray[np.float32]
    point_colors: NDArray[np.uint8]
    thermal_scale: ThermalScale | None
    notes: tuple[str, ...] = field(default=())
    not_found: Mapping[str, Path] = field(default_factory=dict)

    def __repr__(self) -> str:
        frames = (*self.train, *self.test)
        views = " + ".join(
            f"{count} {name}"
            for name, count in (
                ("RGB", sum(frame.rgb is not None for frame in frames)),
                ("thermal", sum(frame.thermal is not None for frame in frames)),
            )
        )
        return (
            f"Capture({self.name!r}, {self.layout}, {len(self.train)} train + {len(self.test)} test frames, "
            f"{views} views, {len(self.points):,} points, {len(self.notes)} notes)"
        )

    @cached_property  # asked for in every training step
    def scene_extent(self) -> float:
        """Radius of the scene [world units]: 1.1 times the largest distance of a train camera from their mean (3DGS).

        A single camera position has no such radius; then the median distance of the points from it stands in.
        """
        return scene_extent([view for frame in self.train for view in _views(frame)], self.points)

    def require(self, *, rgb: bool, thermal: bool) -> None:
        """Check that the capture has what a model is to be made of.

        Args:
            rgb: RGB images are needed.
            thermal: Thermal images are needed.

        Raises:
            UserError: There are no training views of a needed modality.
        """
        wanted: tuple[tuple[Modality, bool], ...] = (("rgb", rgb), ("thermal", thermal))
        for modality, needed in wanted:
            if needed and all(getattr(frame, modality) is None for frame in self.train):
                raise self._lacking(modality)

    def _lacking(self, modality: Modality) -> UserError:
        """The error for a capture without training views of a modality: what was found in their place."""
        name, other = ("RGB", "thermal") if modality == "rgb" else ("thermal", "RGB")
        held_out = sum(getattr(frame, modality) is not None for frame in self.test)
        present = [view.path for frame in (*self.train, *self.test) for view in _views(frame)]
        example = present[0] if present else None
        if held_out:
            found, remedy = f"{held_out} held-out frames have one.", "train on frames that have one"
        elif modality in self.not_found:
            found = f"The files that it names for them do not exist (first looked for: {self.not_found[modality]})."
            remedy = "correct the paths (relative to the capture's folder, or absolute)"
        elif modality == "rgb":
            found, remedy = looked_for_rgb(self.root, example)
        else:
            found, remedy = looked_for_thermal(self.root, example)
        return UserError(
            f"{self.root} has no {name} images with a camera to train on, and the model asks for them. {found}",
            f"{remedy[0].upper()}{remedy[1:]}, or train on {other} alone: --model.no-{modality}.",
        )


def scene_extent(views: list[View], points: NDArray[np.float32]) -> float:
    """See `Capture.scene_extent`."""
    centers = np.array([camera_center(view.viewmat) for view in views])
    mean = centers.mean(0)
    radius = float(np.linalg.norm(centers - mean, axis=1).max())
    if radius < 1e-6 and len(points):
        radius = float(np.median(np.linalg.norm(points - mean, axis=1)))
    return 1.1 * radius


def _views(frame: Frame) -> list[View]:
    return [view for view in (frame.rgb, frame.thermal) if view is not None]
