"""Training images as other views see them. Their depths, which say what is hidden, are rendered where one is needed."""

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from thermosplat.datasets.capture import Frame
from thermosplat.datasets.frame_tensors import ViewTensors, view_tensors, without_pixels
from thermosplat.scene.model import SceneModel
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermography.reprojection import HIDDEN, coarse_view, sampled, seen_from

_KEPT = 512
"""Images, and depths, that are kept."""


class TrainingImages:
    """The images of training frames, at a size that tells what is hidden.

    Args:
        model: The scene.
        frames: The frames.
        spectrum: A spectrum that measures something.
        scale: What its pixel values mean.
        device: Where the model is.
    """

    def __init__(
        self,
        model: SceneModel,
        frames: Sequence[Frame],
        spectrum: str,
        scale: PixelScale,
        device: torch.device | str,
    ) -> None:
        self._model, self._frames, self._spectrum, self._scale, self._device = model, frames, spectrum, scale, device
        self.camera = lru_cache(_KEPT)(self._camera)
        self.picture = lru_cache(_KEPT)(self._picture)
        self._depths: dict[tuple[str, int], Tensor] = {}

    def depth(self, spectrum: str, index: int) -> Tensor:
        """Depths of an image of a spectrum, [H, W]."""
        if (spectrum, index) not in self._depths:
            if len(self._depths) >= _KEPT:
                self._depths.pop(next(iter(self._depths)))
            camera, own = self.camera(spectrum, index), spectrum == self._spectrum
            surfaces = Surfaces(self._model, camera)
            self._depths[spectrum, index] = surface_of(spectrum, surfaces) if own else surfaces[spectrum][0]
        return self._depths[spectrum, index]

    def knows_depth(self, spectrum: str, index: int) -> bool:
        """Whether a depth is there; else it takes a while."""
        return (spectrum, index) in self._depths

    def measured(self, view: ViewTensors) -> Tensor:
        """Values of an image, [H, W]; within the range that a scene can show."""
        if view.values is not None:
            span = self._scale.range
            return view.values if span is None else view.values.clamp(*span)
        assert view.image is not None  # noqa: S101  a view of a capture
        values: Tensor = self._scale.value(pixel_intensity(view.image, self._scale))
        return values

    def seen_from(self, spectrum: str, index: int, view: ViewTensors, points: Tensor, deep: str) -> Tensor:
        """An image as it looks from a view, [H, W, C]; NaN where it is hidden.

        Args:
            spectrum: The image's.
            index: Number of its frame.
            view: From where it is seen.
            points: What the view's pixels see, in its camera's axes, [H, W, 3].
            deep: The spectrum whose depths these are, which says what is hidden.
        """
        positions, visible = self.shown(index, view, points, deep)
        if spectrum != deep:
            positions, _ = seen_from(self.camera(spectrum, index), view, points)
        return torch.where(visible[..., None], sampled(self.picture(spectrum, index), positions), torch.nan)

    def shown(self, index: int, view: ViewTensors, points: Tensor, deep: str) -> tuple[Tensor, Tensor]:
        """Where points lie in an image [px], and whether it shows them."""
        camera = self.camera(deep, index)
        positions, depths = seen_from(camera, view, points)
        size = torch.tensor([camera.width, camera.height], device=positions.device)
        if not ((positions >= 0) & (positions <= size)).all(dim=-1).any():  # no depth is needed
            return positions, torch.zeros_like(depths, dtype=torch.bool)
        return positions, depths <= (1 + HIDDEN) * sampled(self.depth(deep, index)[..., None], positions)[..., 0]

    def _camera(self, spectrum: str, index: int) -> ViewTensors:
        return coarse_view(without_pixels(self._frames[index].views[spectrum], self._device))

    def _picture(self, spectrum: str, index: int) -> Tensor:
        """Values of the measured spectrum, else colours in [0, 1], [H, W, C]."""
        view = view_tensors(self._frames[index].views[spectrum], None, self._device)
        shown = self.measured(view)[..., None] if spectrum == self._spectrum else view.image
        assert shown is not None  # noqa: S101  a view of a capture
        camera = self.camera(spectrum, index)
        size = (camera.height, camera.width)
        return torch.nn.functional.interpolate(shown.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)


class Surfaces(dict[str, tuple[Tensor, Tensor]]):
    """A view's ``render_surface`` by spectrum, each rendered when it is first asked for."""

    def __init__(self, model: SceneModel, view: ViewTensors) -> None:
        super().__init__()
        self.model, self._view = model, view

    def __missing__(self, spectrum: str) -> tuple[Tensor, Tensor]:
        self[spectrum] = self.model.render_surface(spectrum, self._view)
        return self[spectrum]


def surface_of(spectrum: str, surfaces: Surfaces) -> Tensor:
    """Depth of what a spectrum sees in a view, [H, W].

    What is as cold as the range's lower end may be transparent in the spectrum: its depth there is another one's.
    """
    depth, solid = surfaces[spectrum]
    for other in surfaces.model.spectra:
        if other != spectrum and not solid.all():
            theirs, there = surfaces[other]
            depth = torch.where(~solid & there, theirs, depth)
    return depth
