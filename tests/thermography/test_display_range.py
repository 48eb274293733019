"""Pictures are coloured between robust ends: a cold corner does not make the rest one colour."""

from dataclasses import replace

import numpy as np
import pytest

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.pictures.image_display import spectrum_bytes
from thermosplat.thermal.radiometry import FLIR_IRON, PixelScale
from thermosplat.thermography.display_range import display_range
from thermosplat.viewer.layers import Layer, LayerRenderer
from toy_scene import toy_capture
from viewed_toy import viewed_toy


def with_values(values: np.ndarray, span: tuple[float, float], kind: str = "scalar") -> Capture:
    """The toy capture with thermal values, whose intensities stand for a range."""
    capture = toy_capture(thermal_kind=kind)
    scale = PixelScale(kind, FLIR_IRON, span, "celsius")
    view = replace(capture.train[0].views["thermal"], values=values.astype(np.float32))
    frame = Frame("a", {**capture.train[0].views, "thermal": view})
    return replace(capture, train=(frame,), scales={**capture.scales, "thermal": scale})


def test_one_cold_corner_is_left_out() -> None:
    """Of 10 to 106 °C with a corner at -56 °C the range begins near 10; without the corner it is the whole one."""
    values = np.random.default_rng(0).uniform(10, 40, (180, 240))
    cold = values.copy()
    cold[0, 0] = -56.0
    low, high = display_range(with_values(cold, (-56.0, 40.0)), "thermal")
    assert 5 < low < 12
    assert high == pytest.approx(40.0, abs=2.0)
    assert display_range(with_values(values, (10.0, 40.0)), "thermal") == (10.0, 40.0)


def test_what_keeps_its_range() -> None:
    """Pseudo-colours are colours already, and photographs have no range."""
    capture = with_values(np.full((18, 24), 20.0), (-56.0, 40.0), "color")
    assert display_range(capture, "thermal") == (-56.0, 40.0)
    assert display_range(capture, "rgb") is None


def test_pictures_use_it() -> None:
    """The ends of the range are the palette's; beyond them its end colours hold."""
    scale = PixelScale("scalar", FLIR_IRON, (0.0, 100.0), "celsius")
    image = np.array([[[0.0], [0.2], [0.3], [1.0]]], np.float32)
    shown = spectrum_bytes(image, scale, (20.0, 30.0))
    ends = np.rint(FLIR_IRON.to_color(np.array([0.0, 0.0, 1.0, 1.0])) * 255)
    np.testing.assert_array_equal(shown[0], ends)
    scene = viewed_toy(thermal_kind="scalar")
    scene.display_ranges = {"thermal": (20.0, 25.0)}
    layer = Layer("image", "thermal")
    view = scene.view(scene.start().viewmat, 40.0, 24, 18)
    assert LayerRenderer(scene).render([layer], view)[layer].range == (20.0, 25.0)
