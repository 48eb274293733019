"""Viewpoints along a path, and the images taken there."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from thermosplat.camera_paths import look_to
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.image_display import rgb_bytes, thermal_bytes
from thermosplat.rendering import rendered_images, viewpoints
from toy_scene import HEIGHT, WIDTH, toy_capture, toy_config, toy_model


def moving_capture(**kind: Any) -> Capture:
    """The toy capture with four training poses and one held-out one; the thermal camera keeps its place in the rig."""
    capture = toy_capture(**kind)
    frame = capture.train[0]

    def seen_from(x: float, name: str):
        pose = look_to(np.array([x, -0.3 * x, -4.0]), np.array([-x, 0.3 * x, 4.0]), np.array([0.0, -1.0, 0.0]))
        rgb_to_world = np.linalg.inv(frame.rgb.viewmat)
        views = [
            None if view is None else dataclasses.replace(view, viewmat=view.viewmat @ rgb_to_world @ pose)
            for view in (frame.rgb, frame.thermal)
        ]
        return dataclasses.replace(frame, name=name, rgb=views[0], thermal=views[1])

    train = tuple(seen_from(x, str(x)) for x in (-1.0, -0.3, 0.4, 1.0))
    return dataclasses.replace(capture, train=train, test=(seen_from(0.1, "held out"),))


@pytest.mark.parametrize("path", ["interp", "ellipse", "spiral"])
def test_aligned_cameras_share_one_viewpoint(path: str) -> None:
    """Where both spectra have one camera they keep having one along the path, so that one traversal renders both."""
    points = viewpoints(moving_capture(), path, "both", num_frames=5, device="cpu")
    assert len(points) == 5
    assert all(point.rgb is point.thermal for point in points)
    assert (points[0].rgb.width, points[0].rgb.height) == (WIDTH, HEIGHT)


def test_thermal_camera_rides_along() -> None:
    """With cameras of their own the thermal one keeps its intrinsics, size and place beside RGB."""
    capture = moving_capture(aligned=False)
    points = viewpoints(capture, "interp", "both", num_frames=7, device="cpu")
    relative = capture.train[0].thermal.viewmat @ np.linalg.inv(capture.train[0].rgb.viewmat)
    for point in points:
        assert (point.thermal.width, point.thermal.height) == (16, 14)
        np.testing.assert_allclose(point.thermal.viewmat.numpy(), relative @ point.rgb.viewmat.numpy(), atol=1e-5)
    np.testing.assert_allclose(points[-1].thermal.viewmat.numpy(), capture.train[-1].thermal.viewmat, atol=1e-5)


def test_split_paths_are_the_captures_own_views() -> None:
    """train and test are the views as they were taken, one spectrum or both."""
    capture = moving_capture(aligned=False)
    for path, frames in (("train", capture.train), ("test", capture.test)):
        points = viewpoints(capture, path, "both", num_frames=99, device="cpu")
        assert len(points) == len(frames)
        for point, frame in zip(points, frames):
            np.testing.assert_allclose(point.thermal.viewmat.numpy(), frame.thermal.viewmat, atol=1e-6)
            np.testing.assert_allclose(point.rgb.K.numpy(), frame.rgb.camera.K, rtol=1e-6)
    assert all(point.rgb is None for point in viewpoints(capture, "train", "thermal", num_frames=1, device="cpu"))


def test_missing_views_are_explained() -> None:
    """A path through views the capture does not have is refused with what helps."""
    no_test = dataclasses.replace(moving_capture(), test=())
    with pytest.raises(UserError, match="no test views"):
        viewpoints(no_test, "test", "both", num_frames=1, device="cpu")
    rgb_only = moving_capture(thermal=False)
    with pytest.raises(UserError, match="no thermal views"):
        viewpoints(rgb_only, "interp", "thermal", num_frames=3, device="cpu")
    with pytest.raises(UserError, match="no frame with both spectra"):
        viewpoints(rgb_only, "interp", "both", num_frames=3, device="cpu")


@pytest.mark.parametrize("shown", ["rgb", "thermal", "both"])
@pytest.mark.parametrize("kind", ["color", "scalar"])
def test_images_are_what_the_model_renders(shown: str, kind: str) -> None:
    """Images are the model's renders in 8 bits, RGB on the left of thermal."""
    capture = moving_capture(thermal_kind=kind)
    model = toy_model(toy_config(), capture)
    points = viewpoints(capture, "test", shown, num_frames=1, device="cpu")
    (image,) = rendered_images(model, points, sh_degree=1, thermal_scale=capture.thermal_scale)
    both = viewpoints(capture, "test", "both", num_frames=1, device="cpu")[0]
    rendered = model.render(both.rgb, both.thermal, sh_degree=1)
    rgb = rgb_bytes(rendered.rgb.detach().numpy())
    thermal = thermal_bytes(rendered.thermal.detach().numpy(), capture.thermal_scale)
    expected = {"rgb": rgb, "thermal": thermal, "both": np.concatenate([rgb, thermal], axis=1)}[shown]
    assert image.shape == expected.shape
    np.testing.assert_allclose(image.astype(int), expected.astype(int), atol=1)


def test_other_sizes_stand_side_by_side() -> None:
    """A thermal image of its own size is scaled to the RGB image's height."""
    capture = moving_capture(aligned=False)
    model = toy_model(toy_config(), capture)
    points = viewpoints(capture, "spiral", "both", num_frames=2, device="cpu")
    images = list(rendered_images(model, points, sh_degree=1, thermal_scale=capture.thermal_scale))
    assert [image.shape for image in images] == [(HEIGHT, WIDTH + round(16 * HEIGHT / 14), 3)] * 2
