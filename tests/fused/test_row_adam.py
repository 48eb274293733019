"""Adam of some rows: a float64 reference, row by row, and torch's Adam where all rows are used."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from thermosplat.fused.row_adam import RowAdam, Rows
from thermosplat.torch_bridge.host_rows import in_host_rows
from warp_kernels.training import row_adam

RATE, EPS, BETAS = 0.1, 1e-15, (0.9, 0.999)
COUNT, BASES = 23, 15


def optimizer_of(values: Tensor, device: torch.device, on_host: bool = False) -> tuple[torch.nn.Parameter, RowAdam]:
    """A parameter of these values, on the device or in the host's memory, and its optimizer."""
    parameter = torch.nn.Parameter(in_host_rows(values, device) if on_host else values.clone().to(device))
    return parameter, RowAdam([parameter], lr=torch.full((), RATE, device=device), eps=EPS)


def use_rows(optimizer: RowAdam, indices: Tensor, gradient: Tensor, blocked: float = 0.0) -> None:
    """A step that has used rows: their first coefficients have a gradient."""
    parameter = optimizer.parameter
    device = parameter.device
    values = parameter.detach()[indices.to(device), : gradient.shape[1]].clone().requires_grad_()
    values.grad = gradient.to(device)
    optimizer.rows = Rows(indices.to(device), values)
    optimizer.step_rows(torch.full((), blocked, device=device))


def draws(step: int, bases: int) -> tuple[Tensor, Tensor]:
    """Some rows, ascending, and a gradient of any size for them."""
    generator = torch.Generator().manual_seed(step)
    indices = torch.where(torch.rand(COUNT - 1, generator=generator) < 0.4)[0]  # the last row is never used
    scale = 10.0 ** (step % 7 - 4)
    return indices, torch.randn(len(indices), bases, 3, generator=generator) * scale


@pytest.mark.parametrize(("at_once", "on_host", "near"), [(2**30, False, 0), (50, True, 0), (2**30, True, 9)])
def test_rows_follow_the_equations(
    device: torch.device, monkeypatch: pytest.MonkeyPatch, at_once: int, on_host: bool, near: int
) -> None:
    """Forty steps, coefficients of more degrees one after the other: used rows move, others and their moments wait."""
    monkeypatch.setattr(row_adam, "THREADS", at_once)
    start = torch.randn(COUNT, BASES, 3, generator=torch.Generator().manual_seed(0))
    parameter, optimizer = optimizer_of(start, device, on_host)
    optimizer.rows_on_device = near
    p, m, v = start.double(), torch.zeros_like(start).double(), torch.zeros_like(start).double()
    beta1, beta2 = BETAS
    for step in range(1, 41):
        bases = (0, 3, 8, 15)[(step - 1) // 10]
        indices, gradient = draws(step, bases)
        use_rows(optimizer, indices, gradient)
        for row, g in zip(indices.tolist(), gradient.double(), strict=True):
            m[row, :bases] = beta1 * m[row, :bases] + (1 - beta1) * g
            v[row, :bases] = beta2 * v[row, :bases] + (1 - beta2) * g * g
            root = (v[row, :bases] / (1 - beta2**step)).sqrt()
            p[row, :bases] -= RATE * m[row, :bases] / (1 - beta1**step) / (root + EPS / math.sqrt(1 - beta2**step))
    state = optimizer.state[parameter]
    assert state["step"] == 40
    torch.testing.assert_close(parameter.detach().cpu().double(), p, rtol=3e-6, atol=3e-6)
    torch.testing.assert_close(state["exp_avg"].cpu().double(), m, rtol=1e-5, atol=1e-6)  # of gradients up to 300
    torch.testing.assert_close(state["exp_avg_sq"].cpu().double(), v, rtol=1e-5, atol=1e-12)
    assert torch.equal(parameter.detach()[-1].cpu(), start[-1])
    assert not state["exp_avg"][-1].any()


@pytest.mark.parametrize("decay", [0.0, 0.5])
def test_all_rows_are_torchs_adam(device: torch.device, decay: float) -> None:
    """Where every step uses all rows, parameter, moments and count are those of ``torch.optim.AdamW``."""
    start = torch.randn(COUNT, 8, generator=torch.Generator().manual_seed(0))
    parameter, optimizer = optimizer_of(start, device)
    optimizer.param_groups[0]["weight_decay"] = decay
    other = torch.nn.Parameter(start.clone())
    reference = torch.optim.AdamW([other], lr=RATE, eps=EPS, weight_decay=decay)
    for step in range(20):
        other.grad = torch.randn(COUNT, 8, generator=torch.Generator().manual_seed(step))
        use_rows(optimizer, torch.arange(COUNT), other.grad)
        reference.step()
    torch.testing.assert_close(parameter.detach().cpu(), other.detach(), rtol=2e-6, atol=2e-6)
    for key, value in reference.state[other].items():
        torch.testing.assert_close(optimizer.state[parameter][key].cpu(), value, rtol=1e-5, atol=1e-7)


def test_a_blocked_step_changes_nothing(device: torch.device) -> None:
    """NaN behind the flag touches neither parameter, moments nor count."""
    parameter, optimizer = optimizer_of(torch.ones(COUNT, 8), device)
    use_rows(optimizer, torch.tensor([1, 4]), torch.ones(2, 8))
    before = [value.clone() for value in (parameter.detach(), *optimizer.state[parameter].values())]
    use_rows(optimizer, torch.tensor([1, 5]), torch.full((2, 8), torch.nan), blocked=1.0)
    after = [parameter.detach(), *optimizer.state[parameter].values()]
    assert all(map(torch.equal, after, before))
    assert before[0][1, 0].item() == pytest.approx(1.0 - RATE)


def test_a_step_that_used_nothing_is_none(device: torch.device) -> None:
    """Without rows there is no update and no state; a step of a frame that saw none of them is counted."""
    parameter, optimizer = optimizer_of(torch.ones(COUNT, 8), device)
    optimizer.step_rows(torch.zeros((), device=device))
    assert not optimizer.state
    use_rows(optimizer, torch.zeros(0, dtype=torch.int64), torch.zeros(0, 8))
    assert optimizer.state[parameter]["step"] == 1
    assert torch.equal(parameter.detach().cpu(), torch.ones(COUNT, 8))


def test_state_is_torchs(device: torch.device) -> None:
    """Moments go to torch's Adam and come back from it."""
    parameter, optimizer = optimizer_of(torch.ones(COUNT, 8), device)
    use_rows(optimizer, torch.tensor([1, 4]), torch.ones(2, 8))
    other = torch.nn.Parameter(torch.ones(COUNT, 8))
    reference = torch.optim.Adam([other], lr=RATE)
    reference.load_state_dict(optimizer.state_dict())
    again, back = optimizer_of(torch.ones(COUNT, 8), device)
    back.load_state_dict(reference.state_dict())
    assert back.state[again].keys() == {"step", "exp_avg", "exp_avg_sq"}
    for key, value in optimizer.state[parameter].items():
        assert torch.equal(back.state[again][key], value)
        assert torch.equal(reference.state[other][key].cpu(), value.cpu())
    assert back.param_groups[0]["lr"].item() == pytest.approx(RATE)


@pytest.mark.parametrize("on_host", [True, False])
def test_places_of_moments_do_not_matter(device: torch.device, on_host: bool) -> None:
    """To the bit: none, some or all moments on the device, looked at after any step or never."""
    start = torch.randn(COUNT, BASES, 3, generator=torch.Generator().manual_seed(0))
    states = []
    for near, looks in ((0, ()), (9, ()), (9, range(0, 20, 3)), (100, ())):
        parameter, optimizer = optimizer_of(start, device, on_host)
        optimizer.rows_on_device = near
        for step in range(1, 21):
            use_rows(optimizer, *draws(step, (8, 15)[step // 11]))
            if step in looks:
                assert optimizer.state[parameter]["exp_avg"].any()
        found = optimizer.state[parameter]
        states.append([parameter.detach(), found["exp_avg"], found["exp_avg_sq"], found["step"]])
    for other in states[1:]:
        assert all(map(torch.equal, other, states[0]))


def test_what_is_written_to_the_state_counts(device: torch.device) -> None:
    """Moments that somebody clears, or puts in the place of others, are those of the next step."""
    parameter, optimizer = optimizer_of(torch.ones(COUNT, 8), device)
    other, reference = optimizer_of(torch.ones(COUNT, 8), device)
    optimizer.rows_on_device = 9
    rows, gradient = torch.arange(COUNT), torch.ones(COUNT, 8)
    for one in (optimizer, reference):
        use_rows(one, rows, gradient)
        one.state[one.parameter]["exp_avg"][torch.tensor([2, 20], device=device)] = 0.0
        use_rows(one, rows, 2.0 * gradient)
        one.state[one.parameter]["exp_avg_sq"] = torch.full((COUNT, 8), 0.5, device=device)
        use_rows(one, rows, gradient)
    assert torch.equal(parameter, other)
    assert not torch.equal(parameter[2], parameter[3])
    assert torch.equal(optimizer.state[parameter]["exp_avg_sq"], reference.state[other]["exp_avg_sq"])


def test_moments_leave_the_device_by_halves(device: torch.device) -> None:
    """Whoever needs the room asks until there are none; they are all there still."""
    parameter, optimizer = optimizer_of(torch.ones(COUNT, 8), device)
    optimizer.rows_on_device = 16
    use_rows(optimizer, torch.arange(COUNT), torch.ones(COUNT, 8))
    assert optimizer.near is not None
    assert len(optimizer.near) == 16
    left = []
    while optimizer.leave_more_room():
        left.append(optimizer.rows_on_device)
        assert optimizer.near is None
    assert left == [8, 4, 2, 0]
    assert (optimizer.state[parameter]["exp_avg"] != 0).all()


def test_a_full_device_keeps_fewer_moments(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no room for as many rows as were asked for, the step takes as many as there is room for."""
    parameter, optimizer = optimizer_of(torch.ones(COUNT, 8), device)
    other, reference = optimizer_of(torch.ones(COUNT, 8), device)
    optimizer.rows_on_device = 16
    empty = torch.empty

    def small(shape: Any, **kwargs: Any) -> Tensor:
        if shape in ((16, 16), (8, 16)):
            raise torch.OutOfMemoryError
        return empty(shape, **kwargs)

    for one in (optimizer, reference):
        use_rows(one, torch.tensor([1]), torch.ones(1, 8))
        one.bring_home()
    monkeypatch.setattr("thermosplat.fused.row_adam.torch.empty", small)
    use_rows(optimizer, torch.arange(COUNT), torch.ones(COUNT, 8))
    monkeypatch.undo()
    use_rows(reference, torch.arange(COUNT), torch.ones(COUNT, 8))
    assert optimizer.rows_on_device == 4
    assert torch.equal(parameter, other)


def test_other_states_are_left_to_be_refused(device: torch.device) -> None:
    """Moments of another shape, or with one missing, are taken over as they are."""
    for given in ({"exp_avg": torch.ones(3, 8), "exp_avg_sq": torch.ones(3, 8)}, {"exp_avg": torch.ones(COUNT, 8)}):
        parameter, optimizer = optimizer_of(torch.ones(COUNT, 8), device)
        optimizer.load_state_dict({"state": {0: {"step": torch.tensor(1.0), **given}}})
        assert optimizer.state[parameter].keys() == {"step", *given}
        assert optimizer.state[parameter]["exp_avg"] is given["exp_avg"]
