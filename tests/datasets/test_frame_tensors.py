"""Frames as tensors."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from capture_folders import HEIGHT, WIDTH, temperatures, write_rgbt_scenes

from thermosplat.config import ThermalConfig
from thermosplat.datasets import load_capture
from thermosplat.datasets.frame_tensors import frame_tensors, packed, packed_elsewhere, place_in_frame


def test_pseudo_color_frame(tmp_path):
    """Images in [0, 1], intensity by the inverse palette, degrees, camera; all float32."""
    capture = load_capture(write_rgbt_scenes(tmp_path, raw=True))
    frame = capture.train[0]
    tensors = frame_tensors(frame, capture.thermal_scale, "cpu")
    assert tensors.name == frame.name
    assert tensors.aligned
    np.testing.assert_allclose(tensors.rgb.image.numpy(), frame.rgb.image / 255, atol=1e-6)
    assert tensors.rgb.intensity is None
    assert tensors.rgb.celsius is None
    thermal = tensors.thermal
    assert thermal.image.shape == (HEIGHT, WIDTH, 3)
    assert (thermal.width, thermal.height) == (WIDTH, HEIGHT)
    assert thermal.intensity.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(thermal.intensity.numpy(), (temperatures(1) - 15) / 20, atol=0.01)
    np.testing.assert_allclose(thermal.celsius.numpy(), temperatures(1), atol=0.006)
    np.testing.assert_allclose(thermal.K.numpy(), frame.thermal.camera.K)
    np.testing.assert_allclose(thermal.viewmat.numpy(), frame.thermal.viewmat, atol=1e-6)
    for tensor in (thermal.image, thermal.intensity, thermal.celsius, thermal.K, thermal.viewmat):
        assert tensor.dtype == torch.float32


def test_scalar_frame(tmp_path):
    """The intensity of a scalar thermal image is the image."""
    capture = load_capture(write_rgbt_scenes(tmp_path, raw=True), thermal=ThermalConfig(source="raw"))
    thermal = frame_tensors(capture.train[0], capture.thermal_scale, "cpu").thermal
    assert thermal.image.shape == (HEIGHT, WIDTH, 1)
    torch.testing.assert_close(thermal.intensity, thermal.image[..., 0])


def test_missing_modality_is_none(tmp_path):
    """A frame without thermal needs no scale; one with thermal does."""
    root = write_rgbt_scenes(tmp_path)
    (root / "thermal" / "train" / "0001.png").unlink()
    capture = load_capture(root)
    assert frame_tensors(capture.train[0], None, "cpu").thermal is None
    with pytest.raises(ValueError, match="thermal scale"):
        frame_tensors(capture.train[1], None, "cpu")


def test_a_packed_frame_is_one_copy(tmp_path, device: torch.device) -> None:
    """The same tensors in one memory, whose copy moves all of them, also of a frame without one of its views."""
    capture = load_capture(write_rgbt_scenes(tmp_path, raw=True))
    plain, other = (
        replace(frame_tensors(frame, capture.thermal_scale, device), index=torch.tensor(index, device=device))
        for frame, index in zip(capture.train[:2], (3, 7), strict=True)
    )
    frame, next_frame = packed(plain), packed(other)
    assert frame.memory is not None
    assert next_frame.memory is not None
    assert len(plain.packable()) == len(frame.packable()) == 8
    assert all(torch.equal(a, b) for a, b in zip(frame.packable(), plain.packable(), strict=True))
    places = [place_in_frame(frame, tensor) for tensor in frame.packable()]
    assert places == [place_in_frame(next_frame, tensor) for tensor in next_frame.packable()]
    assert all(place % 16 == 0 for place in places)
    for view in (frame, replace(frame, rgb=None, aligned=False)):
        static = packed_elsewhere(view)
        assert static.memory is not None
        assert static.memory.data_ptr() != frame.memory.data_ptr()
        static.memory.copy_(next_frame.memory)
        expected = other if view.rgb is not None else replace(other, rgb=None)
        assert all(torch.equal(a, b) for a, b in zip(static.packable(), expected.packable(), strict=True))
        assert static.index == 7
