"""A capture in memory: frames with one view per spectrum, sparse points, and what pixel values mean."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.cameras import Camera, camera_center
from thermosplat.datasets.geo_file import GeoFrame
from thermosplat.datasets.images.image_folders import looked_for
from thermosplat.datasets.images.pixel_meaning import SpectrumPixels
from thermosplat.datasets.placement import WORLD, Placement
from thermosplat.datasets.readouts import Readout
from thermosplat.datasets.stored_pixels import ImagesOnDisk, StoredPixels
from thermosplat.errors import UserError
from thermosplat.spectra import DEFAULT_SPECTRA, SpectrumConfig, label, listed
from thermosplat.thermal.radiometry import PixelScale


@dataclass(frozen=True, eq=False, repr=False)
class View:
    """One image with its camera.

    Args:
        spectrum: Name of the spectrum.
        name: File name without its ending.
        path: The image file.
        camera: Pinhole intrinsics at the size of `image`.
        viewmat: [4, 4] float64, scene to camera, OpenCV axes.
        image: uint8 [H, W, 3] for photographs and pseudo-colours; float32 [H, W, 1] in [0, 1] for one value per pixel.
            None where the pixels stay on the disk.
        values: float32 [H, W], measured values in the unit of the spectrum's scale, such as °C, where the data has
            them and they do not stay on the disk.
        mask: bool [H, W], where pixels are trained on and count in metrics; None: everywhere, or it stays on the disk.
        stored: Where the pixels are that stay on the disk.
        readout: How its lines were read one after the other; None: all at once.
    """

    spectrum: str
    name: str
    path: Path
    camera: Camera
    viewmat: NDArray[np.float64]
    image: NDArray[np.uint8] | NDArray[np.float32] | None
    values: NDArray[np.float32] | None = None
    mask: NDArray[np.bool_] | None = None
    stored: StoredPixels | None = None
    readout: Readout | None = None

    def __post_init__(self) -> None:
        if (self.image is None) == (self.stored is None):
            raise ValueError(f"{self.name}: the pixels of a view are in memory or on the disk.")

    @property
    def channels(self) -> int:
        """Of the image."""
        return self.image.shape[2] if self.stored is None else self.stored.channels  # type: ignore[union-attr]

    def pixels(self) -> SpectrumPixels:
        """Image, values and mask, read from the disk where they stay there.

        Raises:
            ImageLostError: They cannot be read any more.
        """
        return self.stored.read() if self.image is None else SpectrumPixels(self.image, self.values, self.mask)  # type: ignore[union-attr]

    def __repr__(self) -> str:
        channels = "1 channel" if self.channels == 1 else f"{self.channels} channels"
        values = ", on the disk" if self.image is None else "" if self.values is None else ", with values"
        size = f"{self.camera.width}x{self.camera.height} px"
        return f"View({self.spectrum} {self.name!r}, {size}, {channels}{values})"


def _same_camera(one: View, other: View) -> bool:
    """Whether two views share camera, size, pose and readout."""
    together = other.readout is None if one.readout is None else one.readout.is_same_as(other.readout)
    return together and other.camera == one.camera and np.array_equal(other.viewmat, one.viewmat)


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """One exposure: the views that were taken together, by spectrum, in the order of the spectra."""

    name: str
    views: Mapping[str, View]

    def __repr__(self) -> str:
        return f"Frame({self.name!r}, {', '.join(map(repr, self.views.values())) or 'no views'})"

    @cached_property
    def shared_cameras(self) -> tuple[tuple[str, ...], ...]:
        """Spectra in groups whose views share camera, size and pose, so that one traversal renders a group."""
        groups: list[list[str]] = []
        for name, view in self.views.items():
            for group in groups:
                other = self.views[group[0]]
                if _same_camera(view, other):
                    group.append(name)
                    break
            else:
                groups.append([name])
        return tuple(map(tuple, groups))

    @property
    def aligned(self) -> bool:
        """Whether there are several views, and all share camera, size and pose."""
        return len(self.views) > 1 and len(self.shared_cameras) == 1


@dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """Everything training and evaluation take from a folder.

    Args:
        name: The folder's name, or "sample".
        root: The folder.
        layout: "rgbt-scenes", "colmap", "colmap-rig" or "transforms": how the folder was read.
        train: Frames to learn from, by name.
        test: Held-out frames, by name.
        points: [M, 3] float32 sparse points, in the scene's frame.
        point_colors: [M, 3] uint8.
        scales: Meaning of the pixel values by spectrum; of those that have images only.
        notes: What the user should be told once, a line each.
        not_found: By spectrum, the first of the image files that the capture names and that do not exist.
        spectra: The spectra that were looked for.
        on_disk: Where pixels stay on the disk, what images may take in memory; None: all are in memory.
        placement: Where the scene, whose frame poses and points have, lies in the world of the folder's own poses.
        geo: Where that world lies on the Earth; None: the folder does not say.
    """

    name: str
    root: Path
    layout: str
    train: tuple[Frame, ...]
    test: tuple[Frame, ...]
    points: NDArray[np.float32]
    point_colors: NDArray[np.uint8]
    scales: Mapping[str, PixelScale]
    notes: tuple[str, ...] = field(default=())
    not_found: Mapping[str, Path] = field(default_factory=dict)
    spectra: Mapping[str, SpectrumConfig] = field(default_factory=lambda: dict(DEFAULT_SPECTRA))
    on_disk: ImagesOnDisk | None = None
    placement: Placement = WORLD
    geo: GeoFrame | None = None

    def __repr__(self) -> str:
        frames = (*self.train, *self.test)
        views = " + ".join(f"{sum(name in frame.views for frame in frames)} {label(name)}" for name in self.spectra)
        return (
            f"Capture({self.name!r}, {self.layout}, {len(self.train)} train + {len(self.test)} test frames, "
            f"{views} views, {len(self.points):,} points, {len(self.notes)} notes)"
        )

    @cached_property  # asked for in every training step
    def scene_extent(self) -> float:
        """Radius of the scene [world units]: 1.1 times the largest distance of a train camera from their mean (3DGS).

        A single camera position has no such radius; then the median distance of the points from it stands in.
        """
        return scene_extent([view for frame in self.train for view in frame.views.values()], self.points)

    @property
    def unscented(self) -> bool:
        """Whether a training view is seen through a lens or read line by line, which takes the unscented transform."""
        views = (view for frame in self.train for view in frame.views.values())
        return any(view.camera.lens is not None or view.readout is not None for view in views)

    def training_frames(self, spectra: Collection[str]) -> list[Frame]:
        """The training frames with the views of some spectra alone; those without any are left out.

        Args:
            spectra: Names of the spectra.
        """
        frames = (
            replace(frame, views={name: view for name, view in frame.views.items() if name in spectra})
            for frame in self.train
        )
        return [frame for frame in frames if frame.views]

    def placed(self, placement: Placement) -> "Capture":
        """The same capture in another scene's frame, such as that of a run that goes on.

        Args:
            placement: Where that scene lies in the world.
        """
        if placement == self.placement:
            return self

        def moved(view: View) -> View:
            viewmat = placement.viewmat_to_scene(self.placement.viewmat_to_world(view.viewmat))
            readout = None if view.readout is None else view.readout.scaled(self.placement.unit / placement.unit)
            return replace(view, viewmat=viewmat, readout=readout)

        def placed(frame: Frame) -> Frame:
            return Frame(frame.name, {name: moved(view) for name, view in frame.views.items()})

        points = placement.to_scene(self.placement.to_world(self.points)).astype(np.float32)
        train, test = (tuple(map(placed, frames)) for frames in (self.train, self.test))
        return replace(self, train=train, test=test, points=points, placement=placement)

    def require(self, spectra: Collection[str]) -> None:
        """Check that the capture has what a model is to be made of.

        Args:
            spectra: Names of the spectra that are needed.

        Raises:
            UserError: There are no training views of a needed spectrum.
        """
        for name in spectra:
            if all(name not in frame.views for frame in self.train):
                raise self._lacking(name, [other for other in spectra if other != name])

    def _lacking(self, name: str, others: list[str]) -> UserError:
        """The error for a capture without training views of a spectrum: what was found in their place."""
        held_out = sum(name in frame.views for frame in self.test)
        present = [view for frame in (*self.train, *self.test) for view in frame.views.values()]
        if held_out:
            found, remedy = f"{held_out} held-out frames have one.", "train on frames that have one"
        elif name in self.not_found:
            found = f"The files that it names for them do not exist (first looked for: {self.not_found[name]})."
            remedy = "correct the paths (relative to the capture's folder, or absolute)"
        else:
            found, remedy = looked_for(self.root, name, self.spectra, present[0].path if present else None)
        alone = f", or train on {listed(others)} alone: --without {name}" if others else ""
        return UserError(
            f"{self.root} has no {label(name)} images with a camera to train on, and the model asks for them. {found}",
            f"{remedy[0].upper()}{remedy[1:]}{alone}.",
        )


def scene_extent(views: list[View], points: NDArray[np.float32]) -> float:
    """See `Capture.scene_extent`."""
    centers = np.array([camera_center(view.viewmat) for view in views])
    mean = centers.mean(0)
    radius = float(np.linalg.norm(centers - mean, axis=1).max())
    if radius < 1e-6 and len(points):
        radius = float(np.median(np.linalg.norm(points - mean, axis=1)))
    return 1.1 * radius
