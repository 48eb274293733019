"""What one Gaussian becomes when several take its place, by gsplat's name."""

import math

import pytest
import torch

from thermosplat import UserError, compute_relocation
from thermosplat.fused.relocation import MOST_COPIES, scale_factors, shared_opacities

BINOMS = torch.tensor([[math.comb(n, k) for k in range(MOST_COPIES)] for n in range(MOST_COPIES)], dtype=torch.float32)


@pytest.mark.parametrize("copies", [1, 2, 5, MOST_COPIES])
@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.999])
def test_line_integral_stays(opacity: float, copies: int) -> None:
    """Blended along a line, n Gaussians cover as much as the one they came from, and as much at its centre."""
    opacities, counts = torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
    shared, sigma = shared_opacities(opacities, counts), scale_factors(opacities, counts)
    assert 1 - (1 - shared.item()) ** copies == pytest.approx(opacity)
    x = torch.linspace(-20.0, 20.0, 200_001, dtype=torch.float64)
    together = 1 - (1 - shared * torch.exp(-0.5 * (x / sigma) ** 2)) ** copies
    assert torch.trapezoid(together, x).item() == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-6)


def test_factors_as_the_publication_writes_them() -> None:
    """The double sum of 3DGS-MCMC's equation 9."""
    opacity, n = 0.7, 4
    shared = 1 - (1 - opacity) ** (1 / n)
    denominator = sum(
        math.comb(i - 1, k) * (-1) ** k * shared ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, n + 1)
        for k in range(i)
    )
    factor = scale_factors(torch.tensor([opacity], dtype=torch.float64), torch.tensor([n]))
    assert factor.item() == pytest.approx(opacity / denominator)


def test_gsplats_function() -> None:
    """Equation 9 in the shapes that MCMCStrategy gives; the ratios stay the caller's, and are held to the table."""
    opacities = torch.tensor([[0.006], [0.7], [0.7], [1.0], [0.0]])
    scales, ratios = torch.rand(5, 3), torch.tensor([2, 4, 99, 3, 2])
    new, new_scales = compute_relocation(opacities, scales, ratios, BINOMS)
    assert ratios.tolist() == [2, 4, 99, 3, 2]
    assert (new.shape, new.dtype, new_scales.dtype) == ((5, 1), torch.float32, torch.float32)
    torch.testing.assert_close(new[1], 1 - 0.3 ** torch.tensor([1 / 4]))
    torch.testing.assert_close(new[2], 1 - 0.3 ** torch.tensor([1 / MOST_COPIES]))
    expected = scale_factors(torch.tensor([0.006, 0.7, 0.7]).double(), torch.tensor([2, 4, MOST_COPIES])).float()
    torch.testing.assert_close(new_scales[:3], scales[:3] * expected[:, None])
    assert torch.isfinite(new_scales).all()
    torch.testing.assert_close(new_scales[4], scales[4])


def test_least_opacities_as_gsplats_main_branch_has_them() -> None:
    """min_opacity holds before sizes are computed, so that faint ones shrink."""
    arguments = (torch.tensor([0.006]), torch.ones(1, 3), torch.tensor([4]), BINOMS)
    new, scales = compute_relocation(*arguments, min_opacity=0.005)
    assert new.item() == pytest.approx(0.005)
    total = sum((-1) ** (m - 1) * math.comb(4, m) * 0.005**m / math.sqrt(m) for m in range(1, 5))
    assert scales[0, 0].item() == pytest.approx(0.006 / total, rel=1e-5)


def test_wrong_shapes_are_told() -> None:
    """One sentence has all three."""
    with pytest.raises(UserError, match=r"must have shapes \[N\], \[N, 3\] and \[N\], got \[2\], \[1, 3\]"):
        compute_relocation(torch.ones(2), torch.ones(1, 3), torch.ones(2), BINOMS)
