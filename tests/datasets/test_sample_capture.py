"""The capture that comes with the package."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap

from thermosplat.datasets import load_capture


def test_sample_loads_by_name():
    """42 + 6 aligned pairs with palette, span and degrees for the held-out views, and nothing to warn of."""
    capture = load_capture("sample")
    assert capture.name == "sample"
    assert capture.layout == "rgbt-scenes"
    assert (len(capture.train), len(capture.test)) == (42, 6)
    assert capture.notes == ()
    assert all(frame.aligned for frame in (*capture.train, *capture.test))
    assert capture.train[0].views["rgb"].image.shape == (150, 200, 3)
    assert len(capture.points) == 3247
    scale = capture.scales["thermal"]
    assert scale.range == (20.0, 41.5)
    assert len(scale.palette.colors) == 256
    for frame in capture.test:
        shown = scale.value(scale.palette.to_intensity(frame.views["thermal"].image / 255))
        assert np.abs(shown - np.clip(frame.views["thermal"].values, 20.0, 41.5)).mean() < 0.3


def test_sample_points_lie_in_view():
    """Most sparse points project into most images: poses, intrinsics and points belong together."""
    capture = load_capture("sample")
    inside = []
    for frame in capture.train:
        camera = (
            frame.views["rgb"].viewmat[:3, :3] @ capture.points.T.astype(np.float64)
            + frame.views["rgb"].viewmat[:3, 3:]
        )
        pixels = (frame.views["rgb"].camera.K @ camera)[:2] / camera[2]
        size = np.array([[frame.views["rgb"].camera.width], [frame.views["rgb"].camera.height]])
        inside.append(((camera[2] > 0) & (pixels > 0).all(0) & (pixels < size).all(0)).mean())
    assert np.mean(inside) > 0.6


def test_sample_is_small():
    """The package carries at most 1.8 MB of it."""
    root = load_capture("sample").root
    assert sum(path.stat().st_size for path in root.rglob("*") if path.is_file()) < 1.8e6


def test_png_can_be_written_after_loading(tmp_path):
    """Reading a model and writing PNGs in one process works in the order in which the package imports things."""
    load_capture("sample")
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    assert cv2.imwrite(str(tmp_path / "a.png"), image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png")), image)
    assert pycolmap.Reconstruction(Path(load_capture("sample").root) / "sparse" / "0").num_images() == 48
