"""Temperatures of rendered images, as they are or recalculated, each pixel over its own path through the air."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import CELSIUS
from thermosplat.thermal.intensity import pixel_intensity
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.thermal.recalculation import Recalculation
from thermosplat.thermography.label_images import LabelImages
from thermosplat.thermography.reprojection import distances


@dataclass(frozen=True, eq=False)
class Values:
    """Measured values of a picture."""

    values: Tensor
    """[H, W], in the unit of the spectrum's scale."""
    changed: NDArray[np.bool_] | None = None
    """[H, W], where they were recalculated; None: nowhere."""
    reasons: tuple[str, ...] = ()
    """Why they were not elsewhere."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a recalculation needs to know of a picture beside its temperatures."""

    metres: NDArray[np.float64] | None
    """How far each pixel's object is [m], [H, W], NaN where there is none; None: nobody knows."""
    labels: NDArray[np.int64] | None
    """Label of each pixel, [H, W]; None: there are no labels."""


class SceneTemperatures:
    """How the measured values of a scene's pictures are made.

    Args:
        model: The scene.
        scales: What pixel values mean, by spectrum.
        recalculation: How temperatures are recalculated; None: they are not.
        metres_per_unit: Length of a world unit [m]; None: nobody knows it, and paths are those that files state.
        labels: Label images by spectrum.
    """

    def __init__(
        self,
        model: SceneModel,
        scales: Mapping[str, PixelScale],
        recalculation: Recalculation | None = None,
        *,
        metres_per_unit: float | None = None,
        labels: Mapping[str, LabelImages] | None = None,
    ) -> None:
        self.model = model
        self.scales = scales
        self.recalculation = recalculation
        self.metres_per_unit = metres_per_unit
        self.labels = labels or {}

    def asking(self, settings: TemperatureSettings) -> "SceneTemperatures":
        """The same scene with other settings, if it can be recalculated at all."""
        again = None if self.recalculation is None else self.recalculation.asking(settings)
        return SceneTemperatures(
            self.model, self.scales, again, metres_per_unit=self.metres_per_unit, labels=self.labels
        )

    @property
    def text(self) -> str:
        """For people: "recalculated: emissivity 0.8"; "" where nothing is."""
        return self.recalculation.text if self.recalculation is not None and self._asks_something else ""

    @property
    def notes(self) -> tuple[str, ...]:
        """What to tell people of how it is recalculated."""
        made = self.recalculation
        if made is None or not self._asks_something:
            return ()
        if made.air_is_known and self.metres_per_unit is None:
            path = f"{made.stated.distance:g} m, as is stated"
            return (*made.notes, f"Nobody says how long a unit of the scene is, so the path through the air is {path}.")
        return made.notes

    @property
    def _asks_something(self) -> bool:
        made = self.recalculation
        return made is not None and (bool(made.settings.given) or bool(made.surfaces))

    def recalculates(self, spectrum: str) -> bool:
        """Whether a spectrum's values are others than those of the capture."""
        return self._asks_something and self.scales[spectrum].measured_unit == CELSIUS

    def of_image(self, spectrum: str, image: Tensor, view: ViewTensors) -> Values:
        """The measured values of an image that was rendered from a view.

        Args:
            spectrum: Its spectrum, one that measures something.
            image: The image in [0, 1], [H, W, C].
            view: From where it was rendered.
        """
        values = self.scales[spectrum].value(pixel_intensity(image.clamp(0, 1), self.scales[spectrum]))
        return self.recalculated(spectrum, values, self.surroundings(spectrum, view))

    def surroundings(self, spectrum: str, view: ViewTensors) -> Surroundings | None:
        """What is to be known of a view for ``recalculated``; None where nothing is recalculated."""
        made = self.recalculation
        if made is None or not self.recalculates(spectrum):
            return None
        labels, metric = self.labels.get(spectrum), made.air_is_known and self.metres_per_unit is not None
        if not metric and labels is None:
            return Surroundings(None, None)
        depth = self.model.render_depth(spectrum, view)
        metres = None
        if metric and self.metres_per_unit is not None:
            unit = self.model.placement.unit * self.metres_per_unit
            metres = unit * distances(view, depth).double().cpu().numpy()
        return Surroundings(metres, None if labels is None else labels.seen_in(view, depth))

    def recalculated(self, spectrum: str, values: Tensor, around: Surroundings | None) -> Values:
        """Values of a picture as they are asked for.

        Args:
            spectrum: Their spectrum.
            values: As the capture has them, [H, W].
            around: Of the view (``surroundings``); None: they stay.
        """
        made = self.recalculation
        if made is None or around is None or not self.recalculates(spectrum):
            return Values(values)
        done = made.celsius(values.cpu().numpy(), around.metres, around.labels)
        celsius = torch.as_tensor(done.celsius.astype(np.float32), device=values.device)
        return Values(
            torch.where(torch.as_tensor(done.changed, device=values.device), celsius, values),
            done.changed,
            done.reasons,
        )

    def shown_scale(self, spectrum: str) -> PixelScale:
        """The spectrum's scale, with the temperatures that its palette's ends become."""
        scale, made = self.scales[spectrum], self.recalculation
        if made is None or scale.range is None or not self.recalculates(spectrum):
            return scale
        asked = [
            replace(made, surfaces={}),
            *(made.asking(one.settings.over(made.settings)) for one in made.surfaces.values()),
        ]
        ends = np.stack([one.celsius(np.array(scale.range)).celsius for one in asked])
        return replace(scale, range=(float(ends[:, 0].min()), float(ends[:, 1].max())))
