"""Temperatures of rendered views, recalculated: by pixel, by its own distance, by label, and marked."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from thermosplat.config.temperature_settings import LabelledSurface, TemperatureSettings
from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.errors import UserError
from thermosplat.evaluation.held_out import evaluate
from thermosplat.export.surfaces.depth_views import depth_view
from thermosplat.novel_views.viewpoints import Viewpoint, rendered_images
from thermosplat.thermal.recalculation import Recalculation
from thermosplat.thermal.thermal_parameters import CaptureParameters, ThermalParameters
from thermosplat.thermography.label_images import UNLABELLED, LabelImages
from thermosplat.thermography.reprojection import distances
from thermosplat.thermography.scene_temperatures import SceneTemperatures
from thermosplat.viewer.layers import Layer, LayerRenderer
from viewed_toy import moved, toy_session, viewed_toy

THERMAL = Layer("image", "thermal")
SAID = CaptureParameters(ThermalParameters(applied=True, emissivity=0.95, air_celsius=5.0, humidity=0.9))


@pytest.fixture(scope="module")
def scene():
    return viewed_toy()


def temperatures(scene, metres: float | None = None, labels=None, surfaces=None, **asked: float) -> SceneTemperatures:
    made = Recalculation.of(SAID, TemperatureSettings(**asked), surfaces)
    return SceneTemperatures(scene.model, scene.scales, made, metres_per_unit=metres, labels=labels)


def test_nothing_is_recalculated_unasked(scene) -> None:
    """Without settings a picture has the capture's own values, and no marks."""
    view = scene.view(scene.start().viewmat, 40.0, 24, 18)
    rendered = LayerRenderer(scene).render([THERMAL], view)[THERMAL]
    same = LayerRenderer(scene).render([THERMAL], view, temperatures=temperatures(scene))[THERMAL]
    np.testing.assert_array_equal(rendered.field, same.field)
    assert same.changed is None


@pytest.mark.parametrize("metres", [None, 10.0])
def test_a_layer_is_recalculated_over_each_pixels_distance(scene, metres: float | None) -> None:
    """A picture's values are the formula's for its values and its rays' lengths; colours follow the new range."""
    view = scene.view(scene.start().viewmat, 40.0, 24, 18)
    made = temperatures(scene, metres, emissivity=0.8)
    rendered = LayerRenderer(scene).render([THERMAL], view)[THERMAL]
    done = LayerRenderer(scene).render([THERMAL], view, temperatures=made)[THERMAL]
    far = None
    if metres is not None:
        far = metres * distances(view, scene.model.render_depth("thermal", view)).double().numpy()
        assert np.nanstd(far) > 0.1
    expected = made.recalculation.celsius(rendered.field, far).celsius
    np.testing.assert_allclose(done.field, expected, atol=1e-4)
    assert done.changed.all()
    assert done.range[0] < rendered.range[0] < rendered.range[1] < done.range[1]
    moving = LayerRenderer(scene).render([THERMAL], view, values=False, temperatures=made)[THERMAL]
    np.testing.assert_array_equal(moving.field, done.field)


def test_rays_are_longer_than_depths(scene) -> None:
    """The distance of a pixel beside the middle is its depth over the cosine of its angle."""
    view = scene.view(scene.start().viewmat, 90.0, 20, 20)
    lengths = distances(view, torch.full((20, 20), 2.0))
    assert lengths[10, 10] == pytest.approx(2.0, rel=0.01)
    assert lengths[10, 0] == pytest.approx(2 * np.sqrt(1 + 0.95**2 + 0.05**2), rel=1e-4)
    assert torch.isnan(distances(view, torch.zeros(20, 20))).all()


def test_evaluation_compares_recalculated_with_recalculated(scene) -> None:
    """Both sides become larger apart, and what was 0 stays 0; PSNR is that of the images."""
    plain = evaluate(scene.model, scene.capture, sh_degree=1)
    made = temperatures(scene, emissivity=0.6)
    done = evaluate(scene.model, scene.capture, sh_degree=1, temperatures=made)
    assert done["thermal"]["psnr"] == plain["thermal"]["psnr"]
    assert done["thermal"]["mae_celsius"] > 1.2 * plain["thermal"]["mae_celsius"]
    assert abs(plain["thermal"]["bias_celsius"]) <= plain["thermal"]["mae_celsius"]


def test_pictures_and_files_say_that_they_are_recalculated(scene) -> None:
    """A rendered image has a line above it; points have a property that says which values are others."""
    frame = scene.capture.test[0]
    view = view_tensors(replace(frame.views["thermal"], values=None), None, "cpu")
    how = {"sh_degree": 1, "scales": scene.scales}
    (plain,) = rendered_images(scene.model, [Viewpoint({"thermal": view})], **how)
    made = temperatures(scene, emissivity=0.8)
    (marked,) = rendered_images(scene.model, [Viewpoint({"thermal": view})], **how, temperatures=made)
    assert marked.shape[0] > plain.shape[0]
    seen = depth_view(scene.model, "thermal", view, scene.scales, sh_degree=1, temperatures=made)
    assert set(seen.values) == {"scalar_thermal_celsius", "scalar_thermal_recalculated"}
    assert (seen.values["scalar_thermal_recalculated"] == 1).all()


def write_labels(scene, folder: Path) -> Path:
    """Label images of all frames but the first training one: the left half is 1, the right half 2."""
    (folder / "labels").mkdir()
    for frame in (*scene.capture.train[1:], *scene.capture.test):
        image = np.full((18, 24), 2, np.uint8)
        image[:, :12] = 1
        cv2.imwrite(str(folder / "labels" / f"{frame.views['thermal'].name}.png"), image)
    return folder / "labels.yaml"


def test_labels_of_a_view(scene, tmp_path: Path) -> None:
    """A labelled frame's own view has its label image; another view has those of the frames beside it."""
    labels = LabelImages(scene.capture, scene.model, "thermal", write_labels(scene, tmp_path), "cpu")
    own = view_tensors(scene.capture.test[0].views["thermal"], None, "cpu")
    seen = labels.seen_in(own, scene.model.render_depth("thermal", own))
    assert (seen[:, :12] == 1).all()
    assert (seen[:, 12:] == 2).all()
    other = view_tensors(scene.capture.train[0].views["thermal"], None, "cpu")
    found = labels.seen_in(other, scene.model.render_depth("thermal", other))
    assert set(np.unique(found)) <= {UNLABELLED, 1, 2}
    assert (found != UNLABELLED).mean() > 0.2


def test_surfaces_by_label(scene, tmp_path: Path) -> None:
    """Each label has its emissivity; the mirror keeps its numbers, is hatched, and the legend says why."""
    labels = LabelImages(scene.capture, scene.model, "thermal", write_labels(scene, tmp_path), "cpu")
    surfaces = {
        1: LabelledSurface("wall", TemperatureSettings(emissivity=0.7)),
        2: LabelledSurface("foil", TemperatureSettings(), True),
    }
    made = temperatures(scene, labels={"thermal": labels}, surfaces=surfaces)
    view = view_tensors(scene.capture.test[0].views["thermal"], None, "cpu")
    plain = LayerRenderer(scene).render([THERMAL], view)[THERMAL]
    done = LayerRenderer(scene).render([THERMAL], view, temperatures=made)[THERMAL]
    np.testing.assert_array_equal(done.field[:, 12:], plain.field[:, 12:])
    assert (np.abs(done.field - plain.field)[:, :12] > 1e-3).mean() > 0.9
    assert done.reasons == ("foil: not recalculated, since it mirrors its surroundings.",)
    assert not done.changed[:, 12:].any()


def test_a_capture_without_label_images(scene, tmp_path: Path) -> None:
    """The message names a file that is missing."""
    with pytest.raises(UserError, match=r"no image of toy is labelled \(such as .*labels/view.*png\)"):
        LabelImages(scene.capture, scene.model, "thermal", tmp_path / "labels.yaml", "cpu")


def test_a_session_recalculates_live(scene) -> None:
    """Other settings make another picture at once, the cursor says so, and none of it is trained again."""
    session = toy_session(replace(scene, recalculable=temperatures(scene)))
    session.wish = replace(session.wish, first=THERMAL)
    start = scene.start()
    before = session.render(start, 24, 18)
    value, text = session.probe(0.5, 0.5)
    assert "recalculated" not in text
    session.recalculate(TemperatureSettings(emissivity=0.7))
    after = session.render(start, 24, 18)
    assert (before.picture != after.picture).any() or before.layers[THERMAL].range != after.layers[THERMAL].range
    recalculated, text = session.probe(0.5, 0.5)
    assert recalculated != value
    assert text.endswith("°C (recalculated)")
    session.recalculate(TemperatureSettings())
    assert session.render(moved(start, 0.0), 24, 18).layers[THERMAL].changed is None
