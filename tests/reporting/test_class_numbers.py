"""Numbers of the classes of label images, over made-up views."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.reporting.class_numbers import class_numbers
from thermosplat.scene.formations.labels import LabelFormation
from thermosplat.viewer.measuring import SearchedView


def _view(values: np.ndarray) -> SearchedView:
    K = torch.tensor([[10.0, 0, 5], [0, 10.0, 4], [0, 0, 1]])
    view = ViewTensors(torch.eye(4), K, values.shape[1], values.shape[0])
    frame: Any = SimpleNamespace(name="a")
    return SearchedView(frame, view, values, np.full(values.shape, 2.0), np.zeros((*values.shape, 3)))


class SidesLabels(LabelFormation):
    """Labels whose classes are the left and the right half, whatever is rendered."""

    def __init__(self) -> None:
        torch.nn.Module.__init__(self)
        self.classes = ("left", "right")

    def classes_in(self, image: torch.Tensor) -> torch.Tensor:
        return image


def test_each_class_has_its_numbers() -> None:
    """Of a label file and of a spectrum of labels; what is never seen, or by less than 3x3 pixels, has no row."""
    values = np.tile(np.arange(10.0), (8, 1))
    labels = np.where(values < 4, 1, 2)
    labels[0, 0] = 3
    surfaces = {number: SimpleNamespace(name=name) for number, name in enumerate(("none", "wall", "roof", "speck"))}
    shown = torch.as_tensor(np.where(values < 5, 0, 1))
    scene = SimpleNamespace(
        device="cpu",
        sh_degree=0,
        model=SimpleNamespace(
            placement=SimpleNamespace(unit=1.0),
            spectra=("thermal", "labels"),
            formations={"thermal": None, "labels": SidesLabels()},
            render=lambda views, sh_degree: SimpleNamespace(images={"labels": shown}),
        ),
    )
    made = SimpleNamespace(
        recalculation=SimpleNamespace(surfaces=surfaces),
        labels={"thermal": SimpleNamespace(seen_in=lambda view, depth: labels)},
    )
    measurer: Any = SimpleNamespace(scene=scene, temperatures=made)
    wall, roof, left, right = class_numbers(measurer, "thermal", [_view(values), _view(values + 1)])
    assert (wall.name, wall.minimum, wall.maximum, wall.views) == ("wall", 0.0, 4.0, 2)
    assert abs(wall.area - 31 * 0.04) < 1e-9
    assert (roof.name, roof.mean) == ("roof", 7.0)
    assert (left.name, right.name, right.mean) == ("left", "right", 7.5)
