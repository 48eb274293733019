"""Warp's noise on means is the formula in torch: Σ η, gated by the larger opacity."""

from typing import Literal

import pytest
import torch

from thermosplat.fused.position_noise import add_noise_to_means
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.rotation import rotate

GATE = 100.0, 0.005


def gaussians_of(
    count: int, second: Literal["offsets", "own", "none"], dtype: torch.dtype, device: torch.device
) -> Gaussians:
    """Opacities around the gate's threshold, one quaternion of any length and one without a direction."""
    generator = torch.Generator().manual_seed(count)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    quats = drawn(count, 4)
    quats[0] *= 1e-3
    quats[-1] = 0.0
    parameters = {"means": drawn(count, 3), "quats": quats, "log_scales": drawn(count, 3)}
    parameters["logit_opacities"] = drawn(count) - 5.0
    if second != "none":
        name = "thermal_opacity_offsets" if second == "offsets" else "logit_thermal_opacities"
        parameters[name] = drawn(count) - (0.0 if second == "offsets" else 5.0)
    return Gaussians(parameters).to(device, dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("second", ["offsets", "own", "none"])
@pytest.mark.parametrize("count", [2, 32, 77, 5000])
def test_same_as_torch(
    device: torch.device, count: int, second: Literal["offsets", "own", "none"], dtype: torch.dtype
) -> None:
    """Against torch in float64; a step that is blocked moves nobody."""
    gaussians, exact = (gaussians_of(count, second, kind, device) for kind in (dtype, torch.float64))
    normals = torch.randn(count, 3, generator=torch.Generator().manual_seed(1)).to(device)
    rate = torch.tensor(0.25, device=device)
    before = gaussians.means.detach().clone()
    first = gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities
    stored = *first, *gaussians.stored_second_opacity
    how = {"normals": normals.to(dtype), "strength": 0.5, "rate": rate, "gate": GATE}
    add_noise_to_means(*stored, **how, blocked=torch.ones((), device=device))
    assert torch.equal(gaussians.means, before)
    add_noise_to_means(*stored, **how, blocked=torch.zeros((), device=device))
    with torch.no_grad():
        conjugates = exact.quats * torch.tensor([1.0, -1.0, -1.0, -1.0], device=device)
        within = rotate(exact.quats, exact.scales.square() * rotate(conjugates, normals.double()))
        gate = torch.sigmoid(GATE[0] * (GATE[1] - exact.largest_opacities))
        expected = exact.means + 0.125 * gate[:, None] * within
    assert (expected - exact.means).abs().max() > 1e-3
    tolerance = 2e-5 if dtype is torch.float32 else 1e-12
    torch.testing.assert_close(gaussians.means.detach().double(), expected, rtol=tolerance, atol=tolerance)
