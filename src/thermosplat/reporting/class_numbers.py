"""Numbers of each class that label images name, such as windows, modules and roofs, over all views that see it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from thermosplat.scene.formations.labels import LabelFormation
from thermosplat.viewer.measuring import Measurer, SearchedView

_FEWEST_PIXELS = 9
"""Of a class in a view: 3x3."""


@dataclass(frozen=True)
class ClassNumbers:
    """What the views show of a class."""

    name: str
    area: float
    """Surface across the line of sight in the view that sees the most of it [world units²]."""
    minimum: float
    mean: float
    """Of all pixels in all views."""
    maximum: float
    views: int


def class_numbers(measurer: Measurer, spectrum: str, views: Sequence[SearchedView]) -> list[ClassNumbers]:
    """The classes that are seen, in their order.

    They are those of the label file that temperatures are recalculated by, and of spectra of labels.

    Args:
        measurer: Of the scene.
        spectrum: Whose values.
        views: In which the scene is looked at.
    """
    values: dict[str, list[NDArray[np.float64]]] = {}
    areas: dict[str, list[float]] = {}
    for view in views:
        for name, pixels in _classes(measurer, spectrum, view):
            mine = pixels & view.there
            if mine.sum() >= _FEWEST_PIXELS:
                seen = view.hot(mine)
                values.setdefault(name, []).append(seen.values)
                areas.setdefault(name, []).append(float(seen.areas.sum()))
    rows = []
    for name, parts in values.items():
        every = np.concatenate(parts)
        low, mean, high = float(every.min()), float(every.mean()), float(every.max())
        rows.append(ClassNumbers(name, max(areas[name]), low, mean, high, len(parts)))
    return rows


@torch.no_grad()
def _classes(measurer: Measurer, spectrum: str, view: SearchedView) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Names of classes, and where each is in a view, [H, W]."""
    made, scene = measurer.temperatures, measurer.scene
    if made.recalculation is not None and spectrum in made.labels:
        depth = torch.as_tensor(view.depth / scene.model.placement.unit, dtype=torch.float32, device=scene.device)
        labels = made.labels[spectrum].seen_in(view.view, depth)
        for label, surface in made.recalculation.surfaces.items():
            yield surface.name, labels == label
    for name in scene.model.spectra:
        if isinstance(formation := scene.model.formations[name], LabelFormation):
            image = scene.model.render({name: view.view}, sh_degree=scene.sh_degree).images[name]
            numbers = formation.classes_in(image).cpu().numpy()
            for number, title in enumerate(formation.classes):
                yield title, numbers == number
