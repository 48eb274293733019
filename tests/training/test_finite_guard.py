"""The guard remembers the first bad step by name, however late it is asked."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from thermosplat.fused.finite_check import note_by_warp
from thermosplat.torch_bridge import arrays as warp_bridge
from thermosplat.training.optimizers import FiniteGuard, note_by_torch


def _losses(**values: float) -> dict[str, Tensor]:
    return {name: torch.tensor(value) for name, value in values.items()}


def test_finite_steps_pass() -> None:
    """Nothing is blocked or reported as long as everything is finite."""
    guard = FiniteGuard("cpu")
    guard.observe(torch.tensor(1), _losses(rgb=0.3, thermal=1e30), {"means": [torch.ones(3)], "shN": []})
    assert guard.first_bad() is None
    assert guard.blocked == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_first_bad_loss_is_named(bad: float) -> None:
    """Of several bad steps and terms the first is told, though it is asked for later."""
    guard = FiniteGuard("cpu")
    guard.observe(torch.tensor(3), _losses(rgb=0.3, thermal_smoothness=0.1), {})
    guard.observe(torch.tensor(4), _losses(rgb=0.3, thermal_smoothness=bad), {})
    guard.observe(torch.tensor(5), _losses(rgb=math.nan, thermal_smoothness=math.nan), {})
    assert guard.first_bad() == (4, "thermal_smoothness")
    assert guard.blocked == 1


def test_what_another_rank_found_is_not_this_ones() -> None:
    """Ranks share whether updates are made; a rank whose own values are finite, or that has none, names nothing."""
    guard = FiniteGuard("cpu")
    guard.observe(torch.tensor(1), {}, {"means": []})
    guard.observe(torch.tensor(2), _losses(rgb=0.3), {})
    guard.blocked.fill_(1.0)
    assert guard.first_bad() is None


def test_bad_gradient_is_named() -> None:
    """A finite loss with a NaN in one gradient of several tensors is noticed."""
    guard = FiniteGuard("cpu")
    gradients = {"means": [torch.ones(3)], "decoders": [torch.ones(2), torch.tensor([[1.0, math.nan]])]}
    guard.observe(torch.tensor(9), _losses(rgb=0.3), gradients)
    assert guard.first_bad() == (9, "gradient of decoders")


def test_loss_is_named_before_the_gradients_it_spoils() -> None:
    """A NaN loss makes every gradient NaN; the loss is what the user hears of."""
    guard = FiniteGuard("cpu")
    guard.observe(torch.tensor(2), _losses(rgb=0.3, thermal=math.nan), {"means": [torch.tensor([math.nan])]})
    assert guard.first_bad() == (2, "thermal")


def test_frames_with_other_terms() -> None:
    """A frame without one spectrum has fewer terms; steps of both kinds are watched."""
    guard = FiniteGuard("cpu")
    guard.observe(torch.tensor(1), _losses(rgb=0.3, thermal=0.1), {})
    guard.observe(torch.tensor(2), _losses(rgb=math.nan), {})
    guard.observe(torch.tensor(3), _losses(rgb=0.3, thermal=math.nan), {})
    assert guard.first_bad() == (2, "rgb")


def test_blocking_is_for_good() -> None:
    """A finite step after a bad one does not lift the block: the last good state is to be kept."""
    guard = FiniteGuard("cpu")
    guard.observe(torch.tensor(1), _losses(rgb=math.nan), {})
    guard.observe(torch.tensor(2), _losses(rgb=0.3), {})
    assert guard.blocked == 1
    assert guard.first_bad() == (1, "rgb")


@pytest.mark.parametrize("bad", [None, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("note", [note_by_torch, note_by_warp])
def test_every_number_of_every_tensor_is_seen(
    device: torch.device, note: Callable[..., None], bad: float | None
) -> None:
    """Torch's sums and Warp's kernel note the same, wherever the number is, in more tensors than one launch takes."""
    if device.type == "cuda" and note is note_by_torch:
        pytest.skip("Warp's kernel is what runs there")
    sizes = [[1], [1], [5, 3], [1024], [2050], [7], *[[3]] * 40]
    for name, place in ((0, 0), (2, 7), (3, 1023), (4, 2049), (4, 0), (45, 1)):
        named = [[torch.ones(size, device=device) for size in some] for some in sizes]
        step = torch.tensor(6, device=device)
        first = torch.zeros(len(sizes), dtype=torch.int64, device=device)
        first[5] = 2
        blocked = torch.zeros((), device=device)
        if bad is not None:
            tensors = named[name]
            part, within = (0, place) if place < len(tensors[0]) else (1, place - len(tensors[0]))
            tensors[part][within] = bad
        note(named, step, first, blocked)
        expected = {5: 2} if bad is None else {5: 2, name: 6}
        assert {at: int(first[at]) for at in torch.where(first > 0)[0].tolist()} == expected
        assert blocked == (0 if bad is None else 1)


@pytest.mark.parametrize("place", [0, 2, 3, 5, 6])
def test_tensors_too_long_to_number_are_seen_in_parts(
    device: torch.device, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    """A bad number in any part of a tensor is noted under the tensor's name."""
    monkeypatch.setattr(warp_bridge, "LONGEST", 3)
    values = torch.ones(7, device=device)
    values[place] = math.nan
    first, blocked = torch.zeros(3, dtype=torch.int64, device=device), torch.zeros((), device=device)
    others = torch.ones(5, device=device), torch.ones(2, 2, device=device)
    note_by_warp([[others[0]], [values], [others[1]]], torch.tensor(3, device=device), first, blocked)
    assert first.tolist() == [0, 3, 0]


def test_a_number_too_large_for_its_square_is_bad(device: torch.device) -> None:
    """Adam keeps squares: 1e30 would never move again."""
    first, blocked = torch.zeros(1, dtype=torch.int64, device=device), torch.zeros((), device=device)
    for value, expected in ((1e19, 0.0), (1e20, 1.0)):
        note_by_warp([[torch.full((5,), value, device=device)]], torch.tensor(3, device=device), first, blocked)
        assert blocked == expected
