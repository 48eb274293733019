"""Lenses of views, for what reads pixels beside the renderer."""

from dataclasses import replace

import pytest
import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.scene.lens_slopes import bent, straightened
from thermosplat.scene.view_directions import view_directions

LENSES = {
    "barrel": ([-0.28, 0.09, -0.01, 0.0, 0.0, 0.0, 0.0, 0.0], "pinhole"),
    "all coefficients": ([0.3, 0.1, 0.005, 0.5, 0.2, 0.02, 0.01, -0.008], "pinhole"),
    "fisheye": ([-0.03, 0.004, -0.002, 0.0003, 0.0, 0.0, 0.0, 0.0], "fisheye"),
}


def view_through(name: str) -> ViewTensors:
    """A camera of 90 degrees and more behind a lens."""
    numbers, model = LENSES[name]
    K = torch.tensor([[30.0, 0.0, 32.0], [0.0, 31.0, 24.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    lens = torch.tensor(numbers, dtype=torch.float64)
    return ViewTensors(torch.eye(4, dtype=torch.float64), K, 64, 48, lens=lens, lens_model=model)


@pytest.mark.parametrize("name", LENSES)
def test_straightening_is_the_inverse(name: str) -> None:
    """Slopes up to 1, on the axis too."""
    view = view_through(name)
    slopes = torch.linspace(-1.0, 1.0, 21, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(slopes, 0.8 * slopes, indexing="ij"), dim=-1)
    torch.testing.assert_close(straightened(bent(grid, view), view), grid, atol=1e-6, rtol=0)


def test_pixels_look_through_the_lens() -> None:
    """What lies along a pixel's direction lands on the pixel."""
    exact = view_through("barrel")
    lens = exact.lens.float() if exact.lens is not None else None
    view = replace(exact, viewmat=exact.viewmat.float(), K=exact.K.float(), lens=lens)
    directions = view_directions(view)
    slopes = bent(directions[..., :2] / directions[..., 2:], view)
    places = slopes * view.K.diagonal()[:2] + view.K[:2, 2]
    x, y = torch.arange(64) + 0.5, torch.arange(48) + 0.5
    expected = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    torch.testing.assert_close(places, expected, atol=1e-4, rtol=0)
