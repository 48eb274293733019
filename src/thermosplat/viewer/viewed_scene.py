"""What a viewer shows: a model with the meaning of its pixel values, and the photographs that it was made from."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.novel_views.bookmarks import Bookmark, fov_camera
from thermosplat.novel_views.camera_paths import focus_point, look_to
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.certainty import Certainty
from thermosplat.thermography.display_range import display_range
from thermosplat.thermography.scene_temperatures import SceneTemperatures

FOV_Y = 50.0
"""Vertical field of view [degrees] where no photograph states one."""


@dataclass
class ViewedScene:
    """A scene to look at. While it is trained, its model and its SH degree change under the viewer's eyes."""

    name: str
    model: SceneModel
    sh_degree: int
    """Highest SH degree in use."""
    scales: dict[str, PixelScale]
    """What pixel values mean, by spectrum of the model."""
    device: torch.device
    capture: Capture | None = None
    """Its photographs; None where there are none."""
    recalculable: SceneTemperatures | None = None
    """How its temperatures can be recalculated; None: they cannot."""

    certainties: Mapping[str, Certainty] = field(default_factory=dict)
    """How sure the values of a spectrum are, by its name."""
    earlier: "EarlierDate | None" = None
    """The scene at an earlier date; None: there is nothing to compare with."""

    @cached_property
    def display_ranges(self) -> dict[str, tuple[float, float] | None]:
        """Values at the palettes' ends by spectrum, wide enough for both dates; None of one that keeps its scale's."""
        capture = self.capture
        ranges = {} if capture is None else {name: display_range(capture, name) for name in self.scales}
        for name, other in ({} if self.earlier is None else self.earlier.scene.display_ranges).items():
            own = ranges.get(name)
            if own is not None and other is not None:
                ranges[name] = min(own[0], other[0]), max(own[1], other[1])
        return ranges

    @property
    def temperatures(self) -> SceneTemperatures:
        """How measured values are made, to begin with."""
        return self.recalculable or SceneTemperatures(self.model, self.scales)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """All frames of the capture, training ones first."""
        return () if self.capture is None else (*self.capture.train, *self.capture.test)

    def view(self, viewmat: NDArray[np.floating], fov_y: float, width: int, height: int) -> ViewTensors:
        """A camera to render from.

        Args:
            viewmat: World to camera, OpenCV axes, shape [4, 4].
            fov_y: Vertical field of view [degrees].
            width: Image width [px].
            height: Image height [px].
        """
        return ViewTensors(
            viewmat=torch.as_tensor(viewmat, dtype=torch.float32, device=self.device),
            K=torch.as_tensor(fov_camera(fov_y, width, height).K, dtype=torch.float32, device=self.device),
            width=width,
            height=height,
        )

    def start(self) -> Bookmark:
        """Where a viewer begins: at a frame in the middle of the capture, else in front of the Gaussians."""
        for frame in self.frames[len(self.frames) // 2 :]:
            if frame.views:
                return frame_bookmark(frame, next(iter(frame.views)))
        centre, radius = self._middle
        distance = 1.2 * radius / np.tan(np.radians(FOV_Y / 2))
        forward = np.array([0.0, 0.0, 1.0])
        viewmat = look_to(centre - distance * forward, forward, np.array([0.0, -1.0, 0.0]))
        return Bookmark("start", viewmat.astype(np.float64), FOV_Y)

    @cached_property
    def up(self) -> NDArray[np.float64]:
        """The direction that the photographs have on top, shape [3]; -y, OpenCV's, without any."""
        ups = [-view.viewmat[1, :3] for frame in self.frames for view in frame.views.values()]
        mean = np.mean(ups, axis=0) if ups else np.zeros(3)
        length = np.linalg.norm(mean)
        return mean / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])

    @cached_property
    def focus(self) -> NDArray[np.float64]:
        """The point that the photographs look at, shape [3]; the middle of the Gaussians without any."""
        poses = [np.linalg.inv(view.viewmat) for frame in self.frames for view in frame.views.values()]
        return focus_point(np.stack(poses)).astype(np.float64) if len(poses) > 1 else self._middle[0]

    @cached_property
    def frame_spacing(self) -> float:
        """Median distance from a frame to the next one [world units]; a tenth of the scene's radius without any."""
        centers = np.array([np.linalg.inv(next(iter(f.views.values())).viewmat)[:3, 3] for f in self.frames if f.views])
        if len(centers) < 2:
            return 0.1 * self._middle[1]
        distances = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
        np.fill_diagonal(distances, np.inf)
        return float(np.median(distances.min(axis=1))) or 0.1 * self._middle[1]

    @cached_property
    def _middle(self) -> tuple[NDArray[np.float64], float]:
        """Median of the Gaussians' centres, and the median distance from it [world units]."""
        with torch.no_grad():
            means: Tensor = torch.cat([self.model.gaussians(name).means for name in self.model.gaussian_sets])
            means = means[means.isfinite().all(dim=1)]
            if not len(means):
                return np.zeros(3), 1.0
            centre = means.median(dim=0).values
            radius = (means - centre).norm(dim=1).median().item()
        return centre.double().cpu().numpy(), radius or 1.0


@dataclass(frozen=True, eq=False)
class EarlierDate:
    """What a scene was at an earlier date, as thermosplat-compare found it."""

    scene: ViewedScene
    to_later: MapFrame
    """From its scene to the later one."""
    spectrum: str
    """Whose values were compared."""
    shift: float
    """What all of them changed by."""
    span: float
    """Difference at either end of the palette."""

    def view(self, later: ViewTensors) -> ViewTensors:
        """A camera of the later scene in this one."""
        viewmat = self.to_later.viewmat_to_scene(later.viewmat.double().cpu().numpy())
        return replace(later, viewmat=torch.as_tensor(viewmat, dtype=torch.float32, device=later.viewmat.device))


def frame_bookmark(frame: Frame, spectrum: str) -> Bookmark:
    """The view of a frame in a spectrum, as a camera that looks through the centre of its picture."""
    view = frame.views[spectrum]
    fov = float(np.degrees(2 * np.arctan(view.camera.height / (2 * view.camera.fy))))
    return Bookmark(frame.name, view.viewmat, fov)
