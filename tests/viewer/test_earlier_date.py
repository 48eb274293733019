"""The layers of an earlier date: its image from the same place, and what changed since then."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from field_scene import HIGH, LOW, field_model
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.errors import UserError
from thermosplat.export.maps.map_frame import MapFrame
from thermosplat.scene.gaussians import SH_C0
from thermosplat.thermography.comparison_file import read_comparison
from thermosplat.viewer.layers import Layer, LayerRenderer, available_layers
from thermosplat.viewer.opening import open_scene
from thermosplat.viewer.viewed_scene import EarlierDate, ViewedScene
from thermosplat.viewer.wish import start_wish

TO_LATER = MapFrame(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), 2.0, np.array([3.0, 1.0, -2.0]))
CHANGE, BEFORE, IMAGE = Layer("change", "thermal"), Layer("before", "thermal"), Layer("image", "thermal")


@torch.no_grad()
def two_dates() -> tuple[ViewedScene, ViewTensors]:
    """A field that is 3 °C warmer than before in the west, where a car of 2 units stood; the earlier scene has axes and
    units of its own."""
    model, capture = field_model(np.eye(3))
    before, _ = field_model(np.eye(3))
    for name in model.spectra:
        west = model.gaussians(name).means[:, 0] < 0
        model.gaussians(name).sh0.data += 3.0 / (HIGH - LOW) / SH_C0 * west[:, None, None]
        then = before.gaussians(name)
        car = (then.means[:, 0] < -1.5) & (then.means[:, 2] < 1)
        then.means.data[car, 2] += 2.0
        then.means.data = torch.tensor(TO_LATER.to_scene(then.means.numpy()), dtype=torch.float32)
        then.log_scales.data -= np.log(TO_LATER.scale)
    scales, cpu = dict(capture.scales), torch.device("cpu")
    earlier = EarlierDate(ViewedScene("march", before, 0, scales, cpu), TO_LATER, "thermal", 2.0, 4.0)
    scene = ViewedScene("june", model, 0, scales, cpu, capture, earlier=earlier)
    viewmat = np.diag([1.0, -1.0, -1.0, 1.0])
    viewmat[2, 3] = 4.0  # looks down from a height of 4, below the roof
    return scene, scene.view(viewmat, 40.0, 96, 72)


def test_layers_of_two_dates() -> None:
    """From the same place the earlier image is the later one where nothing changed, and the change has its own unit and
    colour bar; where a thing is gone there is no change of a temperature."""
    scene, view = two_dates()
    layers = LayerRenderer(scene).render([IMAGE, BEFORE, CHANGE], view)
    now, before, change = (layers[layer].field for layer in (IMAGE, BEFORE, CHANGE))
    assert now is not None
    assert before is not None
    assert change is not None
    east, middle = np.s_[20:50, 60:90], np.s_[20:50, 30:44]
    assert np.abs(now[east] - before[east]).max() < 0.05
    assert np.median(change[east]) == pytest.approx(-2.0, abs=0.05)
    assert np.median(change[middle]) == pytest.approx(1.0, abs=0.05)
    assert np.isnan(change[20:50, :4]).all()
    assert (layers[CHANGE].unit, layers[CHANGE].range) == ("°C", (-4.0, 4.0))
    assert layers[BEFORE].range == layers[IMAGE].range


def test_both_dates_are_offered() -> None:
    """Every spectrum has a layer of before, and is compared with that; without an earlier date there is none."""
    scene, _ = two_dates()
    layers = available_layers(scene)
    assert {CHANGE, BEFORE, Layer("before", "rgb")} <= set(layers)
    wish = start_wish(layers, ["thermal"])
    assert (wish.first, wish.second) == (IMAGE, BEFORE)
    assert not {CHANGE, BEFORE} & set(available_layers(dataclasses.replace(scene, earlier=None)))


def test_a_file_that_has_no_earlier_date(tmp_path: Path) -> None:
    """A PLY has none, and a folder that is no comparison neither."""
    with pytest.raises(UserError, match="is no run"):
        open_scene(str(tmp_path / "splat.ply"), compare=str(tmp_path))
    (tmp_path / "changes.json").write_text(json.dumps({"format": "something"}))
    with pytest.raises(UserError, match="is not a comparison file"):
        read_comparison(tmp_path)
