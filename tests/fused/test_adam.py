"""Warp's Adam is torch's: same moments, same parameters, same state."""

import pytest
import torch

from thermosplat.fused.adam import WarpAdam, step_together
from thermosplat.torch_bridge import arrays as warp_bridge


@pytest.mark.parametrize(("longest", "decay"), [(2**30, 0.0), (64, 0.0), (64, 0.5)])
def test_same_as_torch(device: torch.device, monkeypatch: pytest.MonkeyPatch, longest: int, decay: float) -> None:
    """Fifty steps with changing rates and gradients of every size, from the same start; also of a tensor in parts, and
    of one that decays."""
    monkeypatch.setattr(warp_bridge, "LONGEST", longest)
    start = torch.randn(33, 5, generator=torch.Generator().manual_seed(0))
    ours, theirs = (torch.nn.Parameter(start.clone().to(where)) for where in (device, "cpu"))
    rate = torch.zeros((), device=device)
    settings = {"eps": 1e-15, "weight_decay": decay}
    warp, reference = WarpAdam([ours], lr=rate, **settings), torch.optim.AdamW([theirs], lr=0.1, **settings)
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


def test_a_parameter_in_another_order_is_refused(device: torch.device) -> None:
    """Its numbers would get the gradients of others."""
    turned = torch.nn.Parameter(torch.ones(2, 3, device=device).mT)
    turned.grad = torch.ones(3, 2, device=device)
    optimizer = WarpAdam([turned], lr=torch.full((), 0.1, device=device))
    optimizer.found_inf = torch.zeros((), device=device)
    with pytest.raises(ValueError, match="not contiguous"):
        optimizer.step()


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


def test_a_blocked_step_of_a_tensor_in_parts(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """No part is updated, and each step is counted once, whatever the number of parts."""
    monkeypatch.setattr(warp_bridge, "LONGEST", 3)
    parameter = torch.nn.Parameter(torch.ones(7, device=device))
    optimizer = WarpAdam([parameter], lr=torch.full((), 0.1, device=device))
    for blocked, updated in ((0.0, True), (1.0, False), (0.0, True)):
        before = parameter.detach().clone()
        parameter.grad = torch.ones(7, device=device)
        optimizer.found_inf = torch.full((), blocked, device=device)
        optimizer.step()
        assert (parameter != before).all() if updated else torch.equal(parameter, before)
    assert optimizer.state[parameter]["step"] == 2
    assert parameter.unique().numel() == 1


def test_many_optimizers_share_the_launches(device: torch.device) -> None:
    """More parameters than one launch takes, of all sizes and alignments, each with its rate and decay."""
    generator = torch.Generator().manual_seed(1)
    sizes = [1, 3, 4, 5, 1023, 1024, 1025, 4096, *range(2, 34)]
    starts = [torch.randn(size, generator=generator) for size in sizes]
    storage = torch.randn(sum(sizes) + 1, generator=generator).to(device)  # gradients that begin anywhere
    results = []
    for together in (True, False):
        parameters = [torch.nn.Parameter(start.clone().to(device)) for start in starts]
        optimizers = [
            WarpAdam([parameter], lr=torch.full((), 0.01 * rate, device=device), eps=1e-15, weight_decay=rate % 3)
            for rate, parameter in enumerate(parameters)
        ]
        for _ in range(3):
            for parameter, gradient in zip(parameters, storage[1:].split(sizes), strict=True):
                parameter.grad = gradient
            if together:
                step_together(optimizers, torch.zeros((), device=device))
            else:
                for optimizer in optimizers:
                    optimizer.found_inf = torch.zeros((), device=device)
                    optimizer.step()
        results.append(parameters)
    assert all(torch.equal(ours, alone) for ours, alone in zip(*results, strict=True))
    assert not torch.equal(results[0][-1].cpu(), starts[-1])
