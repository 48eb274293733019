"""What several views agree on is more exact than what each found alone."""

import torch

from slanted_plane import plane_views
from thermosplat.training.swept_depths.agreeing_depths import agreed_depths
from thermosplat.training.swept_depths.plane_sweep import SweptView


def test_chance_is_averaged_and_errors_go() -> None:
    """Depths with 1% of noise, a tenth of them wrong: what is left is twice as exact, and nothing is wrong."""
    views, depths = plane_views(9)
    generator = torch.Generator().manual_seed(0)
    noisy = []
    for depth in depths:
        one = depth * (1 + 0.01 * torch.randn(depth.shape, generator=generator))
        noisy.append(torch.where(torch.rand(depth.shape, generator=generator) < 0.1, 1.5 * one, one))
    found = agreed_depths([SweptView.of(view) for view in views], noisy)

    def errors(some: list[torch.Tensor]) -> torch.Tensor:
        return torch.cat([((one - true).abs() / true)[one > 0] for one, true in zip(some, depths, strict=True)])

    assert errors(found).median() < errors(noisy).median() / 2
    assert errors(noisy).max() > 0.4
    assert errors(found).quantile(0.99) < 0.02
    assert (found[4] > 0).float().mean() > 0.6


def test_what_nobody_shares_is_unknown() -> None:
    """A view that says something else than all others has no depths, and neither has one that knows none."""
    views, depths = plane_views(6)
    said = [*depths[:4], 1.3 * depths[4], torch.zeros_like(depths[5])]
    found = agreed_depths([SweptView.of(view) for view in views], said)
    assert not found[4].any()
    assert not found[5].any()
    known = found[1] > 0
    assert known.float().mean() > 0.5
    torch.testing.assert_close(found[1][known], depths[1][known], rtol=0.01, atol=0.0)
