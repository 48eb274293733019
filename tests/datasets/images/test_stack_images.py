"""Stacks as coordinates in a basis: what they keep, and what errors say of all channels."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.datasets.frame_files import Shot
from thermosplat.datasets.images.stack_images import read_stacks
from thermosplat.datasets.lens import Lens, rectified_camera
from thermosplat.datasets.stored_pixels import seen_by
from thermosplat.errors import UserError
from thermosplat.scene.formations.stacks import cosines, squared_errors
from thermosplat.spectra import LATENT, SpectrumConfig

RNG = np.random.default_rng(1)


def images(path: Path, stacks: list[np.ndarray], **settings: Any) -> tuple[list[torch.Tensor], np.ndarray]:
    """The training images of stacks, and their basis."""
    shots = []
    for index, stack in enumerate(stacks):
        np.save(path / f"{index}.npy", stack)
        shots.append(Shot(path / f"{index}.npy", Lens("PINHOLE", (9.0, 9.0, 4.0, 3.0), 8, 6), np.eye(4)))
    reading = read_stacks([*shots, None], SpectrumConfig(channels=stacks[0].shape[-1], **settings))
    assert reading.pixels[-1] is None
    assert reading.scale.basis is not None
    return [torch.from_numpy(pixels.image) for pixels in reading.pixels if pixels is not None], reading.scale.basis


def test_errors_are_those_of_all_channels(tmp_path: Path) -> None:
    """40 bands that no 16 coordinates hold: the squared error of a render is the mean over all 40."""
    stacks = [RNG.random((6, 8, 40)).astype(np.float32) for _ in range(3)]
    (true, *_), basis = images(tmp_path, stacks, source="bands", range=(0.0, 2.0))
    made = torch.rand(6, 8, LATENT)
    bands = 40**0.5 * made.numpy() @ basis
    expected = np.square(bands - stacks[0] / 2).mean(axis=-1)
    image = torch.nn.functional.pad((made + 1) / 2, (0, 1))
    np.testing.assert_allclose(squared_errors(image, true), expected, rtol=1e-4)
    assert 0 <= float(true.min()) <= float(true.max()) <= 1


def test_cosines_are_those_of_all_channels(tmp_path: Path) -> None:
    """40 channels of any length; pixels without features do not count."""
    stack = RNG.normal(size=(6, 8, 40)).astype(np.float32)
    stack[0, 0] = 0
    (true,), basis = images(tmp_path, [stack], source="features")
    made = torch.randn(6, 8, LATENT)
    features = made.numpy() @ basis
    lengths = np.linalg.norm(features, axis=-1) * np.maximum(np.linalg.norm(stack, axis=-1), 1e-9)
    expected = (features * stack).sum(axis=-1) / lengths
    image = torch.nn.functional.pad((made + 1) / 2, (0, 1))
    np.testing.assert_allclose(cosines(image, true), expected, atol=1e-5)


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL"])
def test_stacks_are_resampled(tmp_path: Path, model: str) -> None:
    """However many channels there are, at another size, and through a lens."""
    np.save(tmp_path / "a.npy", np.ones((12, 16, 40), np.float32))
    lens = Lens(model, (18.0, 8.0, 6.0, 0.1) if model == "SIMPLE_RADIAL" else (18.0, 18.0, 8.0, 6.0), 16, 12)
    shot = Shot(tmp_path / "a.npy", lens, np.eye(4))
    (pixels,) = read_stacks([shot], SpectrumConfig(channels=40, source="bands", range=(0.0, 2.0))).pixels
    assert pixels is not None
    camera = rectified_camera(lens, 16, 12).resized(8, 6)
    smaller = seen_by(camera, lens, pixels)
    assert smaller.image.shape == (6, 8, LATENT + 1)
    np.testing.assert_allclose(smaller.image, np.broadcast_to(pixels.image[0, 0], smaller.image.shape), atol=1e-6)


def test_few_channels_are_kept_whole(tmp_path: Path) -> None:
    """Three bands have three rows of the basis, and nothing is left."""
    (true,), basis = images(tmp_path, [RNG.random((6, 8, 3)).astype(np.float32)], source="bands")
    assert not basis[3:].any()
    assert float(true[..., -1].max()) < 1e-3


def test_a_basis_may_be_given(tmp_path: Path) -> None:
    """The rows of a file are taken as they are, also those that were found before; others are refused."""
    stacks = [RNG.random((6, 8, 20)).astype(np.float32)]
    rows = np.linalg.qr(RNG.normal(size=(20, 5)))[0].T.astype(np.float32)
    for given in (rows, np.concatenate([rows, np.zeros((11, 20), np.float32)])):
        np.save(tmp_path / "basis.npy", given)
        _, basis = images(tmp_path, stacks, source="bands", basis=str(tmp_path / "basis.npy"))
        np.testing.assert_array_equal(basis[:5], rows)
    for wrong in (2 * rows, rows[:, :7], RNG.random((17, 20)), rows[0]):
        np.save(tmp_path / "basis.npy", wrong)
        with pytest.raises(UserError, match=r"basis.npy holds \[.*\] numbers, which are no basis of 20 channels"):
            images(tmp_path, stacks, source="bands", basis=str(tmp_path / "basis.npy"))
