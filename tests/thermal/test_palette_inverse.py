"""The inverse of a palette for arrays of both kinds. What it finds is tested in test_radiometry.py."""

import numpy as np
import pytest
import torch

from thermosplat.thermal.palette_inverse import Curve, nearest_points
from thermosplat.thermal.radiometry import FLIR_IRON, Palette


@pytest.mark.parametrize("palette", [FLIR_IRON, Palette(FLIR_IRON.colors[::127])], ids=["256 entries", "3 entries"])
def test_tensors_give_what_arrays_give(palette: Palette) -> None:
    """Numpy's arrays and torch's tensors, on the CPU: the same points to the bit; roots may differ in the last one."""
    colors = np.random.default_rng(0).uniform(-0.2, 1.2, (3, 5000)).astype(np.float32)
    curve = Curve(*(torch.tensor(part) for part in palette.curve))
    position, distance = nearest_points(torch.from_numpy(colors), curve, torch)
    expected_position, expected_distance = nearest_points(colors, palette.curve, np)
    assert position.dtype == distance.dtype == torch.float32
    np.testing.assert_array_equal(position.numpy(), expected_position)
    np.testing.assert_allclose(distance.numpy(), expected_distance, rtol=2e-7)


def test_a_colour_that_is_none() -> None:
    """NaN has no nearest point: it gets the coldest, infinitely far away, and disturbs no other."""
    colors = torch.tensor([[torch.nan, 1.0], [0.0, 1.0], [0.0, 1.0]])
    position, distance = nearest_points(colors, Curve(*(torch.tensor(part) for part in FLIR_IRON.curve)), torch)
    assert position.tolist() == [0.0, 1.0]
    assert distance[0] == torch.inf
