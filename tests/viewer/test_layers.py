"""Layers are what the model renders, in the unit that metrics.json's errors have."""

import dataclasses

import numpy as np
import pytest
import torch

from thermosplat.evaluation.held_out import rendered_views
from thermosplat.pictures.image_display import rgb_bytes
from thermosplat.viewer.feature_colors import FeatureColors
from thermosplat.viewer.layers import Layer, LayerRenderer, available_layers
from toy_scene import toy_capture, toy_config, toy_model
from viewed_toy import viewed_toy

SIZE = (48, 36)


def test_the_image_is_the_rasterizers() -> None:
    """RGB is SceneModel.render's image in 8 bits, to the last one."""
    scene = viewed_toy()
    start = scene.start()
    view = scene.view(start.viewmat, start.fov_y, *SIZE)
    layer = Layer("image", "rgb")
    image = LayerRenderer(scene).render([layer], view)[layer]
    with torch.no_grad():
        expected = scene.model.render({"rgb": view}, sh_degree=1).images["rgb"].clamp(0, 1).numpy()
    assert image.colors is not None
    np.testing.assert_array_equal(image.colors, rgb_bytes(expected))
    assert image.colors.std() > 2.5


@pytest.mark.parametrize("kind", ["color", "scalar"])
def test_temperatures_are_those_of_the_metrics(kind: str) -> None:
    """From a held-out frame's own camera, each pixel has the temperature whose error metrics.json averages."""
    scene = viewed_toy(thermal_kind=kind)
    assert scene.capture is not None
    frame = scene.capture.test[0]
    with torch.no_grad():
        judged = {r.spectrum: r for r in rendered_views(scene.model, frame, scene.scales, 1)}["thermal"]
        expected = judged.scale.value(judged.intensity).numpy()
    layer = Layer("image", "thermal")
    image = LayerRenderer(scene).render([layer], judged.camera)[layer]
    assert image.field is not None
    np.testing.assert_array_equal(image.field, expected)
    assert (image.unit, image.quantity) == ("°C", "temperature")
    assert np.ptp(expected) > 1.0


def test_no_degrees_are_invented() -> None:
    """Without a range of temperatures the values are intensities from 0 to 1."""
    scene = viewed_toy(measured=False)
    start = scene.start()
    layers = [Layer("image", "thermal"), Layer("error", "thermal")]
    images = LayerRenderer(scene).render(layers, scene.view(start.viewmat, start.fov_y, *SIZE))
    shown = images[layers[0]]
    assert shown.field is not None
    assert (shown.unit, shown.quantity, shown.range) == ("", "intensity", (0.0, 1.0))
    assert 0 <= shown.field.min() < shown.field.max() <= 1
    assert images[layers[1]].unit == ""


def test_every_layer_renders() -> None:
    """All layers that a scene says it has give values or colours of the asked size, and not one value everywhere."""
    scene = viewed_toy()
    start = scene.start()
    layers = available_layers(scene)
    kinds = {layer.kind for layer in layers}
    assert kinds == {"image", "depth", "opacity", "offset", "features", "error", "photograph"}
    images = LayerRenderer(scene).render(layers, scene.view(start.viewmat, start.fov_y, *SIZE))
    for layer in layers:
        image = images[layer]
        shown = image.field if image.field is not None else image.colors
        assert image.size == SIZE, layer
        assert shown is not None
        assert np.nanstd(shown) > 0, layer


def test_a_scene_of_one_spectrum_has_no_layers_of_others() -> None:
    """Offsets and thermal layers need what renders them; without photographs there are no errors."""
    capture = toy_capture(thermal=False)
    scene = dataclasses.replace(viewed_toy(), model=toy_model(toy_config(without=("thermal",)), capture), capture=None)
    assert {layer.spectrum for layer in available_layers(scene)} == {"rgb"}
    assert {layer.kind for layer in available_layers(scene)} == {"image", "depth", "opacity", "features"}


def test_from_its_own_pose_a_photograph_is_itself() -> None:
    """At the photograph's camera every pixel is the photograph's, and the error is the plain difference."""
    scene = viewed_toy()
    assert scene.capture is not None
    frame = scene.capture.train[1]
    taken = frame.views["thermal"]
    camera = dataclasses.replace(
        scene.view(taken.viewmat, 40.0, taken.camera.width, taken.camera.height),
        K=torch.tensor(taken.camera.K, dtype=torch.float32),
    )
    layers = [Layer("photograph", "rgb"), Layer("error", "thermal"), Layer("image", "thermal")]
    images = LayerRenderer(scene).render(layers, camera)
    np.testing.assert_array_equal(images[layers[0]].colors, frame.views["rgb"].image)
    temperatures = scene.scales["thermal"].value(scene.scales["thermal"].palette.to_intensity(taken.image))
    difference = np.abs(images[layers[2]].field - temperatures)
    np.testing.assert_allclose(images[layers[1]].field, difference, atol=1e-2)


def test_a_photograph_moves_with_the_depth() -> None:
    """Beside its pose a photograph is shifted by what the depth says: a plane at depth z by f x / z pixels."""
    scene = viewed_toy()
    assert scene.capture is not None
    frame = scene.capture.test[0]  # the outermost one
    taken = frame.views["rgb"]
    renderer = LayerRenderer(scene)
    depth, shift = 4.0, 1.0  # px
    scene.model.render_depth = lambda spectrum, view: torch.full((view.height, view.width), depth)  # type: ignore[method-assign]
    camera = dataclasses.replace(
        scene.view(taken.viewmat, 40.0, taken.camera.width, taken.camera.height),
        K=torch.tensor(taken.camera.K, dtype=torch.float32),
    )
    camera.viewmat[0, 3] -= shift * depth / taken.camera.fx
    seen = renderer.photographs.nearest("rgb", camera)
    assert seen.frame is frame
    np.testing.assert_allclose(seen.image[:, :-1].numpy(), taken.image[:, 1:] / 255, atol=1e-4)
    assert seen.image[:, -1].isnan().all()


def test_what_the_photograph_does_not_see_is_left_out() -> None:
    """A point that lies behind what the photograph's camera sees is not coloured by it."""
    scene = viewed_toy()
    assert scene.capture is not None
    taken = scene.capture.train[0].views["rgb"]
    renderer = LayerRenderer(scene)
    depths = iter((4.0, 2.0))  # of the view, then of the photograph, which sees something nearer
    scene.model.render_depth = lambda spectrum, view: torch.full((view.height, view.width), next(depths))  # type: ignore[method-assign]
    view = scene.view(taken.viewmat, 40.0, 24, 18)
    view.viewmat[0, 3] -= 0.05
    assert not renderer.photographs.nearest("rgb", view).valid.any()


def test_features_keep_their_colors() -> None:
    """Principal components: the direction of largest spread is red, and the basis stays when features change."""
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(500, 5, generator=generator) * torch.tensor([0.1, 3.0, 0.2, 1.0, 0.4])
    basis = FeatureColors.of(features, torch.ones(500))
    assert [int(column.abs().argmax()) for column in (basis.components / basis.components.norm(dim=0)).T] == [1, 3, 4]
    colors = basis.colors(features[:, None], torch.ones(500, 1, 1))
    assert 0.1 < colors[..., 0].std() < 0.25
    scene = viewed_toy()
    renderer = LayerRenderer(scene)
    first = renderer.features_basis
    with torch.no_grad():
        scene.model.gaussians("shared").features.mul_(-2.0)
    assert renderer.features_basis is first
