"""Viewpoints along a path, and the images taken there."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError
from thermosplat.novel_views.camera_paths import look_to
from thermosplat.novel_views.viewpoints import rendered_images, viewpoints
from thermosplat.pictures.image_display import side_by_side, spectrum_bytes
from toy_scene import HEIGHT, WIDTH, toy_capture, toy_config, toy_model

BOTH = ["rgb", "thermal"]


def moving_capture(**kind: Any) -> Capture:
    """The toy capture with four training poses and one held-out one; the thermal camera keeps its place in the rig."""
    capture = toy_capture(**kind)
    frame = capture.train[0]

    def seen_from(x: float, name: str):
        pose = look_to(np.array([x, -0.3 * x, -4.0]), np.array([-x, 0.3 * x, 4.0]), np.array([0.0, -1.0, 0.0]))
        rgb_to_world = np.linalg.inv(frame.views["rgb"].viewmat)
        views = {
            spectrum: dataclasses.replace(view, viewmat=view.viewmat @ rgb_to_world @ pose)
            for spectrum, view in frame.views.items()
        }
        return Frame(name, views)

    train = tuple(seen_from(x, str(x)) for x in (-1.0, -0.3, 0.4, 1.0))
    return dataclasses.replace(capture, train=train, test=(seen_from(0.1, "held out"),))


@pytest.mark.parametrize("path", ["interp", "ellipse", "spiral"])
def test_aligned_cameras_share_one_viewpoint(path: str) -> None:
    """Where spectra have one camera they keep having one along the path, so that one traversal renders them."""
    points = viewpoints(moving_capture(), path, BOTH, num_frames=5, device="cpu")
    assert len(points) == 5
    assert all(point.views["rgb"] is point.views["thermal"] for point in points)
    assert (points[0].views["rgb"].width, points[0].views["rgb"].height) == (WIDTH, HEIGHT)


def test_some_cameras_are_shared() -> None:
    """A third spectrum with the RGB camera has it along the path too, while the thermal camera is another."""
    capture = moving_capture(aligned=False, others=("nir",))
    points = viewpoints(capture, "interp", ["nir", "thermal", "rgb"], num_frames=3, device="cpu")
    for point in points:
        assert list(point.views) == ["rgb", "thermal", "nir"]
        assert point.views["rgb"] is point.views["nir"]
        assert (point.views["thermal"].width, point.views["thermal"].height) == (16, 14)
    (own, *_) = viewpoints(capture, "train", ["nir", "thermal", "rgb"], num_frames=1, device="cpu")
    assert own.views["rgb"] is own.views["nir"]
    assert own.views["rgb"] is not own.views["thermal"]


def test_the_first_shown_spectrum_leads() -> None:
    """A path without RGB is made of the thermal camera's poses; the spectrum that shares none rides along."""
    capture = moving_capture(aligned=False, others=("nir",))
    relative = capture.train[0].views["nir"].viewmat @ np.linalg.inv(capture.train[0].views["thermal"].viewmat)
    points = viewpoints(capture, "interp", ["thermal", "nir"], num_frames=4, device="cpu")
    last = capture.train[-1].views["thermal"].viewmat
    np.testing.assert_allclose(points[-1].views["thermal"].viewmat.numpy(), last, atol=1e-5)
    for point in points:
        expected = relative @ point.views["thermal"].viewmat.numpy()
        np.testing.assert_allclose(point.views["nir"].viewmat.numpy(), expected, atol=1e-5)


def test_thermal_camera_rides_along() -> None:
    """With cameras of their own the thermal one keeps its intrinsics, size and place beside RGB."""
    capture = moving_capture(aligned=False)
    points = viewpoints(capture, "interp", BOTH, num_frames=7, device="cpu")
    relative = capture.train[0].views["thermal"].viewmat @ np.linalg.inv(capture.train[0].views["rgb"].viewmat)
    for point in points:
        rgb, thermal = (point.views[name] for name in BOTH)
        assert (thermal.width, thermal.height) == (16, 14)
        np.testing.assert_allclose(thermal.viewmat.numpy(), relative @ rgb.viewmat.numpy(), atol=1e-5)
    last = capture.train[-1].views["thermal"].viewmat
    np.testing.assert_allclose(points[-1].views["thermal"].viewmat.numpy(), last, atol=1e-5)


def test_split_paths_are_the_captures_own_views() -> None:
    """train and test are the views as they were taken, of one spectrum or of several, with the frames' names."""
    capture = moving_capture(aligned=False)
    for path, frames in (("train", capture.train), ("test", capture.test)):
        points = viewpoints(capture, path, BOTH, num_frames=99, device="cpu")
        assert len(points) == len(frames)
        for point, frame in zip(points, frames):
            assert point.frame == frame.name
            viewmat = point.views["thermal"].viewmat.numpy()
            np.testing.assert_allclose(viewmat, frame.views["thermal"].viewmat, atol=1e-6)
            np.testing.assert_allclose(point.views["rgb"].K.numpy(), frame.views["rgb"].camera.K, rtol=1e-6)
    assert all(
        list(point.views) == ["thermal"]
        for point in viewpoints(capture, "train", ["thermal"], num_frames=1, device="cpu")
    )


def test_missing_views_are_explained() -> None:
    """A path through views the capture does not have is refused with what helps."""
    no_test = dataclasses.replace(moving_capture(), test=())
    with pytest.raises(UserError, match="no test views"):
        viewpoints(no_test, "test", BOTH, num_frames=1, device="cpu")
    rgb_only = moving_capture(thermal=False)
    with pytest.raises(UserError, match="no thermal views"):
        viewpoints(rgb_only, "interp", ["thermal"], num_frames=3, device="cpu")
    with pytest.raises(UserError, match="no frame with RGB and thermal") as caught:
        viewpoints(rgb_only, "interp", BOTH, num_frames=3, device="cpu")
    assert caught.value.hint == "Show one of them: --spectra."


@pytest.mark.parametrize("shown", [["rgb"], ["thermal"], ["rgb", "thermal"], ["nir", "rgb"]], ids="-".join)
@pytest.mark.parametrize("kind", ["color", "scalar"])
def test_images_are_what_the_model_renders(shown: list[str], kind: str) -> None:
    """Images are the model's renders in 8 bits side by side, in the order of the model's spectra."""
    capture = moving_capture(thermal_kind=kind, others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {}}), capture)
    points = viewpoints(capture, "test", shown, num_frames=1, device="cpu")
    (image,) = rendered_images(model, points, sh_degree=1, scales=capture.scales)
    every = viewpoints(capture, "test", list(model.spectra), num_frames=1, device="cpu")[0]
    rendered = model.render(every.views, sh_degree=1)
    expected = side_by_side(
        [
            spectrum_bytes(rendered.images[name].detach().numpy(), capture.scales[name])
            for name in ("rgb", "thermal", "nir")
            if name in shown
        ]
    )
    assert image.shape == (HEIGHT, len(shown) * WIDTH, 3)
    np.testing.assert_allclose(image.astype(int), expected.astype(int), atol=1)


def test_other_sizes_stand_side_by_side() -> None:
    """A thermal image of its own size is scaled to the RGB image's height."""
    capture = moving_capture(aligned=False)
    model = toy_model(toy_config(), capture)
    points = viewpoints(capture, "spiral", BOTH, num_frames=2, device="cpu")
    images = list(rendered_images(model, points, sh_degree=1, scales=capture.scales))
    assert [image.shape for image in images] == [(HEIGHT, WIDTH + round(16 * HEIGHT / 14), 3)] * 2
