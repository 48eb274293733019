"""Frames as tensors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from capture_folders import HEIGHT, WIDTH, band16, spectra_with, temperatures, write_image, write_rgbt_scenes
from thermosplat.datasets import load_capture
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.frame_tensors import (
    frame_tensors,
    packed,
    packed_elsewhere,
    place_in_frame,
    with_unit_images,
)
from toy_scene import toy_capture


def test_pseudo_color_frame(tmp_path):
    """Images in [0, 1], intensity by the inverse palette, degrees, camera; all float32."""
    capture = load_capture(write_rgbt_scenes(tmp_path, raw=True))
    frame = capture.train[0]
    tensors = frame_tensors(frame, capture.scales, "cpu")
    assert tensors.name == frame.name
    assert tensors.shared_cameras == (("rgb", "thermal"),)
    np.testing.assert_allclose(tensors.views["rgb"].image.numpy(), frame.views["rgb"].image / 255, atol=1e-6)
    assert tensors.views["rgb"].intensity is None
    assert tensors.views["rgb"].values is None
    thermal = tensors.views["thermal"]
    assert thermal.image.shape == (HEIGHT, WIDTH, 3)
    assert (thermal.width, thermal.height) == (WIDTH, HEIGHT)
    assert thermal.intensity.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(thermal.intensity.numpy(), (temperatures(1) - 15) / 20, atol=0.01)
    np.testing.assert_allclose(thermal.values.numpy(), temperatures(1), atol=0.006)
    np.testing.assert_allclose(thermal.K.numpy(), frame.views["thermal"].camera.K)
    np.testing.assert_allclose(thermal.viewmat.numpy(), frame.views["thermal"].viewmat, atol=1e-6)
    for tensor in (thermal.image, thermal.intensity, thermal.values, thermal.K, thermal.viewmat):
        assert tensor.dtype == torch.float32


def test_scalar_frame(tmp_path):
    """The intensity of a scalar thermal image is the image."""
    capture = load_capture(write_rgbt_scenes(tmp_path, raw=True), spectra=spectra_with(thermal={"source": "raw"}))
    thermal = frame_tensors(capture.train[0], capture.scales, "cpu").views["thermal"]
    assert thermal.image.shape == (HEIGHT, WIDTH, 1)
    torch.testing.assert_close(thermal.intensity, thermal.image[..., 0])


def test_missing_spectrum(tmp_path):
    """A frame without thermal needs no scale of it; one with thermal does."""
    root = write_rgbt_scenes(tmp_path)
    (root / "thermal" / "train" / "0001.png").unlink()
    capture = load_capture(root)
    scales = {"rgb": capture.scales["rgb"]}
    assert list(frame_tensors(capture.train[0], scales, "cpu").views) == ["rgb"]
    with pytest.raises(KeyError, match="thermal"):
        frame_tensors(capture.train[1], scales, "cpu")


def test_some_spectra_of_a_frame():
    """The views that are asked for, in the groups that are left of those that share a camera; all: the same frame."""
    capture = toy_capture(aligned=False, others=("nir", "uv"))
    frame = frame_tensors(capture.train[0], capture.scales, "cpu")
    assert frame.shared_cameras == (("rgb", "nir", "uv"), ("thermal",))
    part = frame.only(["uv", "thermal", "rgb"])
    assert list(part.views) == ["rgb", "thermal", "uv"]
    assert part.shared_cameras == (("rgb", "uv"), ("thermal",))
    assert part.views["uv"] is frame.views["uv"]
    assert frame.only(["thermal"]).shared_cameras == (("thermal",),)
    assert frame.only(["swir"]).views == {}
    assert frame.only(["thermal", "uv", "nir", "rgb", "swir"]) is frame


def test_a_frame_of_three_spectra(tmp_path):
    """A further spectrum's intensity is its image, its values are in its unit; packed, it has a place of its own."""
    root = write_rgbt_scenes(tmp_path)
    for number in range(8):
        write_image(root / "nir" / f"{number:04d}.png", band16(number))
    capture = load_capture(root, spectra=spectra_with(nir={"unit": "reflectance", "factor": 1e-4}))
    tensors = frame_tensors(capture.train[0], capture.scales, "cpu")
    nir = tensors.views["nir"]
    assert tensors.shared_cameras == (("rgb", "thermal", "nir"),)
    torch.testing.assert_close(nir.intensity, nir.image[..., 0])
    np.testing.assert_allclose(nir.values.numpy(), band16(1) * 1e-4, atol=1e-6)
    frame = packed(tensors)
    assert len(frame.packable()) == 3 * 3 + 2
    assert len({place_in_frame(frame, tensor) for tensor in frame.packable()}) == len(frame.packable())
    assert all(torch.equal(a, b) for a, b in zip(frame.packable(), tensors.packable(), strict=True))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("as_bytes", [False, True])
def test_a_packed_frame_is_one_copy(tmp_path, device: torch.device, as_bytes: bool, masked: bool) -> None:
    """The same tensors in one memory, whose copy moves all of them, also of a frame without one of its views."""
    root = write_rgbt_scenes(tmp_path, raw=True)
    for number in range(8) if masked else ():
        for folder in ("rgb", "thermal"):
            write_image(root / "masks" / folder / f"{number:04d}.png", np.tri(24, 32, number, dtype=np.uint8))
    capture = load_capture(root)
    plain, other = (
        replace(
            frame_tensors(frame, capture.scales, device, as_bytes=as_bytes), index=torch.tensor(index, device=device)
        )
        for frame, index in zip(capture.train[:2], (3, 7), strict=True)
    )
    frame, next_frame = packed(plain), packed(other)
    assert frame.memory is not None
    assert next_frame.memory is not None
    assert len(plain.packable()) == len(frame.packable()) == 8 + 2 * masked
    assert all(torch.equal(a, b) for a, b in zip(frame.packable(), plain.packable(), strict=True))
    places = [place_in_frame(frame, tensor) for tensor in frame.packable()]
    assert places == [place_in_frame(next_frame, tensor) for tensor in next_frame.packable()]
    assert all(place % 16 == 0 for place in places)
    for whole_or_part, expected in ((frame, other), (frame.only(["thermal"]), other.only(["thermal"]))):
        static = packed_elsewhere(whole_or_part)
        assert static.memory is not None
        assert static.memory.data_ptr() != frame.memory.data_ptr()
        static.memory.copy_(next_frame.memory)
        assert all(torch.equal(a, b) for a, b in zip(static.packable(), expected.packable(), strict=True))
        assert static.index == 7


def test_images_stay_bytes(device: torch.device) -> None:
    """In a quarter of the memory, whatever their number; in [0, 1] they are what they are without that."""
    image = np.arange(45, dtype=np.uint8).reshape(3, 5, 3)
    capture = toy_capture(thermal=False)
    view = replace(capture.train[0].views["rgb"], camera=Camera(5.0, 5.0, 2.5, 1.5, 5, 3), image=image)
    frame = replace(capture.train[0], views={"rgb": view})
    expected = frame_tensors(frame, capture.scales, device)
    kept = packed(frame_tensors(frame, capture.scales, device, as_bytes=True))
    assert kept.views["rgb"].image.tolist() == image.tolist()
    assert len(kept.memory) == len(packed(expected).memory) - (48 - 16)
    found = with_unit_images(packed_elsewhere(kept))
    assert found.memory is None
    assert torch.equal(found.views["rgb"].image, expected.views["rgb"].image)
    assert with_unit_images(expected) is expected
