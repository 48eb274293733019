"""Intervals that hold what they say, reasons not to read a value, and readings with ±."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from thermosplat.datasets.frame_tensors import view_tensors
from thermosplat.thermography.calibration import Calibration, calibration, read_calibration
from thermosplat.thermography.certainty import DOUBTS, FEW_VIEWS, NO_SURFACE, REFLECTING, Certainty
from thermosplat.thermography.measurements import Measurement
from thermosplat.thermography.picture_structure import noise_of, stands_out
from thermosplat.viewer.layers import Layer, LayerRenderer, available_layers
from thermosplat.viewer.wish import Wish
from viewed_toy import toy_session, viewed_toy

THERMAL = Layer("image", "thermal")


@pytest.fixture(scope="module")
def scene():
    made = viewed_toy()
    certainty = Certainty(made.model, made.capture, "thermal", made.scales["thermal"], sh_degree=1, device="cpu")
    return replace(made, certainties={"thermal": certainty})


def test_intervals_hold_their_share_of_the_views_they_are_made_of(scene) -> None:
    """95 of 100 pixels or more, however wrong the scene is."""
    certainty = scene.certainties["thermal"]
    frames = list(scene.capture.test)
    made = certainty.calibrated(frames)
    error, half, _ = certainty.compared(frames[0], made)
    there = np.isfinite(half)
    assert np.mean(np.abs(error)[there] <= half[there]) > 0.93
    assert len(made.factors) == len(made.edges) + 1


@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_intervals_hold_their_share_of_new_views(drift: float) -> None:
    """Also where the level drifts from view to view, of which four held-out views know few."""
    random = np.random.default_rng(0)

    def view() -> tuple[np.ndarray, np.ndarray]:
        s = random.uniform(0.5, 2.0, 2000)
        return s, 0.1 * s * random.standard_normal(2000) + drift * random.uniform(-1, 1)

    made = calibration(0.05, drift * random.uniform(-1, 1, 60), [view() for _ in range(4)])
    inside = [np.mean(np.abs(errors) <= made.half_width(s)) for s, errors in (view() for _ in range(300))]
    assert 0.93 < np.mean(inside) < 0.97


@pytest.mark.parametrize(
    ("other_at_thermal", "thermal_at_other", "theirs", "differ"),
    [
        (3.0, 3.0, 1.2, True),
        (1.0, 3.0, 1.2, False),
        (3.0, 1.0, 1.2, False),
        (3.0, 3.0, 1.02, False),
        (3.0, 3.0, 0.8, False),
    ],
    ids=["glass", "colours agree at both", "heat agrees at both", "depths agree", "film"],
)
def test_images_tell_whether_spectra_see_different_surfaces(
    scene, monkeypatch, other_at_thermal: float, thermal_at_other: float, theirs: float, differ: bool
) -> None:
    """Depths that differ are not enough: round warm things the thermal depth of plain surfaces is wrong."""
    certainty = scene.certainties["thermal"]
    view = scene.view(scene.start().viewmat, 50.0, 80, 60)
    depth = torch.ones(60, 80)
    other_depth = torch.where(torch.arange(80) < 24, theirs, 1.0).expand(60, 80).contiguous()
    times = {("rgb", 1.0): other_at_thermal, ("thermal", theirs): thermal_at_other}

    def images(spectrum: str, index: int, _: object, at: torch.Tensor, deep: str) -> torch.Tensor:
        height, width = at.shape[:2]  # of the whole view, or of pixels on the left
        size = torch.where(torch.arange(width) < 24, times.get((spectrum, round(at[0, 0, 2].item(), 3)), 1.0), 1.0)
        return (0.1 * index * size).expand(height, width)[..., None]

    monkeypatch.setattr(certainty.images, "seen_from", images)
    order = range(len(certainty.frames))
    everywhere = np.ones((60, 80), bool)
    found = certainty.lies_before("rgb", view, depth, other_depth, torch.from_numpy(everywhere), order, everywhere)
    assert found[:, :20].mean() == differ
    assert not found[:, 24:].any()


def test_what_changes_with_direction_is_not_to_be_read(scene, monkeypatch) -> None:
    """A mirror shows each camera something else, by more than noise, drift and the picture's own edges."""
    certainty = scene.certainties["thermal"]
    view = scene.view(scene.start().viewmat, 50.0, 80, 60)
    mirror = torch.arange(80) < 24

    def images(spectrum: str, index: int, _: object, at: torch.Tensor, deep: str) -> torch.Tensor:
        height, width = at.shape[:2]
        return torch.where(mirror[:width], 20.0 + 5.0 * index, 20.0).expand(height, width)[..., None]

    monkeypatch.setattr(certainty.images, "seen_from", images)
    values = np.full((60, 80), 20.0)
    doubts = certainty.doubts_of(view, values, certainty.look_of(view, values, 0.05, 0.05), 0.05, 0.05)
    surface = doubts & NO_SURFACE == 0
    assert surface[:, :20].any()
    assert (doubts[:, :20][surface[:, :20]] & REFLECTING > 0).mean() > 0.9
    assert not (doubts[:, 30:] & REFLECTING).any()


@pytest.mark.parametrize(("size", "small"), [(2, True), (5, False)])
def test_what_is_smaller_than_three_pixels_of_the_sensor(scene, size: int, small: bool) -> None:
    """A warm spot that no square of 3x3 pixels fits in is not to be read; the ground around it is."""
    view = scene.view(scene.start().viewmat, 50.0, 80, 60)
    values = np.full((60, 80), 20.0)
    values[30 : 30 + size, 40 : 40 + size] = 25.0
    found = stands_out(values, 0.05, torch.ones(60, 80), view, float(view.K[0, 0]))
    assert found[30, 40] == small
    assert not found[10:20, 10:20].any()


def test_a_picture_is_looked_at_once(scene, monkeypatch) -> None:
    """Several measurements of one view ask once; another picture of the same place is looked at anew."""
    certainty, looks = scene.certainties["thermal"], []
    assert certainty.calibration.factors  # looks at held-out views
    look = certainty.look_of
    monkeypatch.setattr(certainty, "look_of", lambda *given: looks.append(1) or look(*given))
    view = scene.view(scene.start().viewmat, 50.0, 40, 30)
    values = np.full((30, 40), 20.0)
    first = certainty.of_view(view, values)
    assert certainty.of_view(view, values.copy()) is first
    certainty.of_view(view, values + 1)
    certainty.of_view(scene.view(scene.start().viewmat, 60.0, 40, 30), values + 1)
    assert len(looks) == 3


def test_a_calibration_is_kept(scene, tmp_path: Path) -> None:
    """The next program reads it; a damaged file is made again."""
    path = tmp_path / "certainty.json"
    how = {"sh_degree": 1, "device": "cpu", "keep": path}
    first = Certainty(scene.model, scene.capture, "thermal", scene.scales["thermal"], **how).calibration
    assert read_calibration(path) == first
    for damage in ("{", '{"noise": 1}', '{"noise": 1, "level": 0, "edges": [1], "factors": [1]}'):
        path.write_text(damage)
        assert read_calibration(path) is None
    assert Certainty(scene.model, scene.capture, "thermal", scene.scales["thermal"], **how).calibration == first


def test_half_widths_follow_their_bins() -> None:
    """Small and large s have factors of their own."""
    made = Calibration(0.1, 0.0, (1.0,), (2.0, 3.0))
    np.testing.assert_allclose(made.half_width(np.array([0.5, 2.0])), [1.0, 6.0])


def test_noise_is_found_beside_structure() -> None:
    """A picture with edges and 0.05 of noise has noise of 0.05."""
    x = np.linspace(0, 6, 200)
    structure = 20 + 5 * np.sin(x)[None] + np.where(x[:, None] > 3, 4.0, 0.0)
    noisy = structure + 0.05 * np.random.default_rng(0).standard_normal((200, 200))
    assert noise_of(noisy) == pytest.approx(0.05, rel=0.15)


def test_what_nobody_saw_is_not_to_be_read(scene) -> None:
    """From behind the cameras there are too few views of anything, and where nothing is drawn there is no surface."""
    start = scene.start()
    turned = start.viewmat.copy()
    turned[:3] = np.diag([-1.0, 1.0, -1.0]) @ turned[:3]
    turned[2, 3] = 4.0
    view = scene.view(turned, 50.0, 24, 18)
    field = LayerRenderer(scene).render([THERMAL], view)[THERMAL].field
    doubts = scene.certainties["thermal"].of_view(view, field).doubts
    nothing = (scene.model.render_depth("thermal", view) <= 0).numpy()
    assert (doubts[nothing] == NO_SURFACE).all()
    assert ((doubts[~nothing] & FEW_VIEWS) > 0).any()


def test_some_pixels_have_the_doubts_that_they_have_among_all(scene) -> None:
    """Whatever is asked for, and though fewer images are looked at; the intervals are those of the whole view."""
    certainty, start = scene.certainties["thermal"], scene.start()
    turned = start.viewmat.copy()
    turned[:3, 3] += (0.8, 0.3, 0.5)
    view = scene.view(turned, 70.0, 60, 44)
    field = LayerRenderer(scene).render([THERMAL], view)[THERMAL].field
    everywhere, x, y = certainty.of_view(view, field), *np.meshgrid(np.arange(60), np.arange(44))
    assert len(np.unique(everywhere.doubts)) > 1
    for where in (x < 20, (x - 30) ** 2 + (y - 20) ** 2 < 80, (x == 40) & (y == 10)):
        some = certainty.of_view(view, field, where)
        np.testing.assert_array_equal(some.doubts[where], everywhere.doubts[where])
        np.testing.assert_array_equal(some.half_width, everywhere.half_width)


def test_readings_have_plus_and_minus(scene) -> None:
    """A spot says ± and why it may not be read; the layer shows the same numbers and hatches the same pixels."""
    session = toy_session(scene)
    doubt = Layer("doubt", "thermal")
    assert doubt in available_layers(scene)
    session.wish = Wish(THERMAL, doubt)
    session.render(scene.start(), 24, 18)
    made = session.measure("spot", [(0.5, 0.5)])
    assert isinstance(made, Measurement)
    assert made.numbers.uncertainty > 0
    assert "±" in made.mean_text
    assert set(made.numbers.doubts) <= set(DOUBTS.values())
    view = scene.view(scene.start().viewmat, scene.start().fov_y, 24, 18)
    layer = LayerRenderer(scene).render([doubt], view)[doubt]
    assert layer.field[9, 12] == pytest.approx(made.numbers.uncertainty, rel=1e-5)
    assert layer.changed[9, 12] == (made.numbers.doubted_share == 0)
    session.wish = Wish(doubt, doubt)
    shown = session.render(scene.start(), 24, 18)
    assert shown.layers[doubt].unit == "°C"


def test_a_training_view_is_not_compared_with_itself(scene) -> None:
    """Its own image would make every render look right."""
    certainty = scene.certainties["thermal"]
    frame = scene.capture.train[0]
    view = view_tensors(frame.views["thermal"], None, "cpu")
    image = scene.model.render({"thermal": view}, sh_degree=1).images["thermal"]
    with torch.no_grad():
        s = certainty.look_of(view, np.full(image.shape[:2], 100.0), 0.0, 0.0).s
    assert np.nanmedian(s) > 50  # its neighbours have 10 to 30 °C


def test_a_view_of_parallel_rays_has_intervals_like_a_cameras(scene) -> None:
    """A map of the same surface from the same place is about as sure as the picture."""
    certainty = scene.certainties["thermal"]
    taken = view_tensors(scene.capture.train[0].views["thermal"], None, "cpu")
    depth = scene.model.render_depth("thermal", taken)
    focal = taken.K.clone()
    focal[[0, 1], [0, 1]] /= float(depth[depth > 0].median())
    parallel = replace(taken, K=focal, orthographic=True)
    widths = []
    for view in (taken, parallel):
        shown = scene.model.render({"thermal": view}, sh_degree=1).images["thermal"].mean(dim=-1).detach().numpy()
        widths.append(np.nanmedian(certainty.of_view(view, shown.astype(np.float32)).half_width))
    assert 0.5 < widths[1] / widths[0] < 2.0
