"""Warp's Adam is torch's: same moments, same parameters, same state."""

import pytest
import torch

from thermosplat.warp_adam import WarpAdam


def test_same_as_torch(device: torch.device) -> None:
    """Fifty steps with changing rates and gradients of every size, from the same start."""
    start = torch.randn(33, 5, generator=torch.Generator().manual_seed(0))
    ours, theirs = (torch.nn.Parameter(start.clone().to(where)) for where in (device, "cpu"))
    rate = torch.zeros((), device=device)
    warp, reference = WarpAdam([ours], lr=rate, eps=1e-15), torch.optim.Adam([theirs], lr=0.1, eps=1e-15)
    warp.found_inf = torch.zeros((), device=device)
    for step in range(50):
        gradient = torch.randn(33, 5, generator=torch.Generator().manual_seed(step)) * 10.0 ** (step % 7 - 4)
        ours.grad, theirs.grad = gradient.to(device), gradient.clone()
        reference.param_groups[0]["lr"] = 0.1 * 0.95**step
        rate.fill_(0.1 * 0.95**step)
        warp.step()
        reference.step()
    torch.testing.assert_close(ours.cpu(), theirs, rtol=2e-6, atol=1e-6)
    for key, value in reference.state[theirs].items():
        torch.testing.assert_close(warp.state[ours][key].cpu(), value, rtol=1e-5, atol=1e-12)


def test_blocked_step_leaves_everything(device: torch.device) -> None:
    """NaN gradients behind the flag touch neither parameter, moments nor count."""
    parameter = torch.nn.Parameter(torch.ones(7, device=device))
    optimizer = WarpAdam([parameter], lr=torch.full((), 0.1, device=device))
    optimizer.found_inf = torch.zeros((), device=device)
    parameter.grad = torch.ones(7, device=device)
    optimizer.step()
    before = [value.clone() for value in (parameter.detach(), *optimizer.state[parameter].values())]
    parameter.grad = torch.full((7,), torch.nan, device=device)
    optimizer.found_inf.fill_(1.0)
    optimizer.step()
    after = [parameter.detach(), *optimizer.state[parameter].values()]
    assert all(torch.equal(a, b) for a, b in zip(after, before, strict=True))
    assert before[0][0].item() == pytest.approx(0.9)


def test_parameters_without_gradient_or_numbers_are_left_out(device: torch.device) -> None:
    """No gradient, no update; an empty parameter (no SH above degree 0) has no state."""
    idle, empty = torch.nn.Parameter(torch.ones(2, device=device)), torch.nn.Parameter(torch.ones(0, 3, device=device))
    empty.grad = torch.ones(0, 3, device=device)
    optimizer = WarpAdam([idle, empty], lr=torch.full((), 0.1, device=device))
    optimizer.found_inf = torch.zeros((), device=device)
    optimizer.step()
    assert torch.equal(idle, torch.ones_like(idle))
    assert not optimizer.state
