"""Warp's kernel notes what density control's own lines note."""

import pytest
import torch

from thermosplat.config import DensificationConfig
from thermosplat.fused.density_notes import note_gradients
from thermosplat.training.density.gradient_control import DefaultStrategy


@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize("blocked", [0.0, 1.0])
def test_same_as_torch(device: torch.device, cameras: int, blocked: float) -> None:
    """Norms in units of half the image and observations, added to sums there are; a blocked step adds nothing."""
    count, generator = 300, torch.Generator().manual_seed(cameras)
    gradient = 1e-4 * torch.randn(cameras, count, 2, generator=generator)
    visible = torch.rand(cameras, count, generator=generator) < 0.6
    if blocked:
        gradient[0, 0] = torch.nan
    strategy = DefaultStrategy(DensificationConfig(), 3.0, count, "cpu")
    strategy.grad_norm_sum += torch.rand(count, generator=generator)
    strategy.observations += 2.0
    sums = [strategy.grad_norm_sum.to(device, copy=True), strategy.observations.to(device, copy=True)]
    before = [value.clone() for value in sums]

    means2d = torch.zeros_like(gradient, requires_grad=True)
    means2d.grad = gradient
    info = {"means2d": means2d, "visible": visible, "width": 40, "height": 30, "n_cameras": cameras}
    strategy.observe([info], torch.tensor(blocked))
    half_size = 20.0 * cameras, 15.0 * cameras
    note_gradients(gradient.to(device), visible.to(device), half_size, torch.tensor(blocked, device=device), *sums)

    torch.testing.assert_close(sums[0].cpu(), strategy.grad_norm_sum)
    assert torch.equal(sums[1].cpu(), strategy.observations)
    assert torch.equal(sums[1], before[1]) == bool(blocked)
