"""SelectiveAdam: gsplat's update of the rows that were seen, on any device."""

import pytest
import torch

from thermosplat import SelectiveAdam, UserError

BETAS, EPS, RATE = (0.9, 0.99), 1e-6, 0.05


def by_hand(rows: torch.Tensor, steps: list[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
    """Adam without correction of bias, of the visible rows."""
    rows, m, v = rows.double().clone(), torch.zeros_like(rows).double(), torch.zeros_like(rows).double()
    for gradient, visible in steps:
        g = gradient.double()[visible]
        m[visible] = BETAS[0] * m[visible] + (1 - BETAS[0]) * g
        v[visible] = BETAS[1] * v[visible] + (1 - BETAS[1]) * g * g
        rows[visible] -= RATE * m[visible] / (v[visible].sqrt() + EPS)
    return rows


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(7,), (7, 3), (7, 4, 3)])
def test_visible_rows_are_updated(device: torch.device, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Three steps, whose rows differ; rows not seen keep numbers and moments, masks may be numbers."""
    torch.manual_seed(3)
    start = torch.randn(shape)
    steps = [(torch.randn(shape), torch.rand(7) < 0.5) for _ in range(3)]
    rows = start.to(device, dtype, copy=True).requires_grad_()
    optimizer = SelectiveAdam([{"params": rows, "lr": RATE, "name": "rows"}], eps=EPS, betas=BETAS)
    for number, (gradient, visible) in enumerate(steps):
        rows.grad = gradient.to(device, dtype)
        optimizer.step(visible.to(device) if number > 0 else visible.float().to(device))
    expected = by_hand(start, steps)
    torch.testing.assert_close(rows.detach().cpu().double(), expected, rtol=1e-5, atol=1e-6)
    assert set(optimizer.state[rows]) == {"step", "exp_avg", "exp_avg_sq"}


def test_sparse_gradients_are_taken(device: torch.device) -> None:
    """Those that sparse_grad=True gives."""
    rows = torch.zeros(4, 3, device=device, requires_grad=True)
    optimizer = SelectiveAdam([rows], eps=EPS, betas=BETAS)
    rows.grad = torch.sparse_coo_tensor([[1]], [[1.0, 2.0, 3.0]], (4, 3), check_invariants=True).to(device)
    seen = torch.tensor([False, True, False, True], device=device)
    optimizer.step(seen)
    assert (rows[1] < 0).all()
    assert (rows[[0, 2, 3]] == 0).all()


def test_masks_of_another_length_are_refused() -> None:
    """The sentence has both shapes."""
    rows = torch.zeros(4, 3, requires_grad=True)
    rows.grad = torch.ones(4, 3)
    optimizer = SelectiveAdam([rows], eps=EPS, betas=BETAS)
    with pytest.raises(UserError, match=r"visibility must have shape \[4\].*got \[3\]"):
        optimizer.step(torch.ones(3))
