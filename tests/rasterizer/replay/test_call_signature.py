"""Calls with one signature are those that one graph can serve."""

from typing import Any

import pytest
import torch

from rasterizer_replays import Bench
from thermosplat import PairCapacity
from thermosplat.errors import UserError
from thermosplat.rasterizer.lenses import RollingShutterType
from thermosplat.rasterizer.replay.call_signature import call_of, is_never_replayed, names_of_tensors, with_tensors


def place(tensor: torch.Tensor) -> Any:
    """Anywhere."""
    return "here"


def key(*arguments: Any, **options: Any) -> Any:
    """Of a call."""
    found = call_of(arguments, options, place)
    return None if found is None else found.key


TENSOR = torch.zeros(4, 3)


def test_numbers_of_tensors_are_not_in_it() -> None:
    """Only what decides about kernels and memory."""
    assert key(TENSOR, width=3) == key(TENSOR + 1, width=3)
    assert key(TENSOR, width=3) == key(torch.nn.Parameter(TENSOR, requires_grad=False), width=3)


@pytest.mark.parametrize(
    "other",
    [
        (torch.zeros(5, 3), 3),
        (torch.zeros(4, 3, dtype=torch.float64), 3),
        (torch.zeros(4, 3, requires_grad=True), 3),
        (torch.zeros(4, 3).to_sparse(), 3),
        (TENSOR, 4),
        (TENSOR, 3.0),
        (TENSOR, "3"),
        (TENSOR, None),
        (TENSOR, RollingShutterType.GLOBAL),
        ((TENSOR, TENSOR), 3),
        (TENSOR, TENSOR),
    ],
)
def test_everything_else_is(other: tuple[Any, ...]) -> None:
    """Shape, type, gradients, layout, numbers and their kinds, what is given at all."""
    assert key(*other) is not None
    assert key(*other) != key(TENSOR, 3)


def test_a_number_and_a_truth_value_differ() -> None:
    """True equals 1 and means something else."""
    assert key(TENSOR, 1) != key(TENSOR, True)


def test_gradients_count_where_they_are_recorded() -> None:
    """Without, a leaf is a constant."""
    leaf = torch.zeros(4, 3, requires_grad=True)
    with torch.no_grad():
        assert key(leaf) == key(TENSOR)
    assert key(leaf) != key(TENSOR)


class _Subclass(torch.Tensor):
    """A kind of tensor that may do anything."""


@pytest.mark.parametrize("given", [[1], object(), _Subclass(), {"a": 1}, torch.float32])
def test_what_is_of_another_kind_has_none(given: Any) -> None:
    """Its values may change, or be more than they seem."""
    assert key(TENSOR, given) is None
    assert call_of((TENSOR,), {}, lambda tensor: None) is None
    assert call_of((3,), {}, place) is None


def test_nothing_is_replayed_where_somebody_looks_into_calls() -> None:
    """Transforms of functorch, forward derivatives, dispatch modes, autocast, rooms of others."""
    from torch.autograd import forward_ad
    from torch.utils.flop_counter import FlopCounterMode

    found = []
    torch.func.vmap(lambda one: found.append(key(one)) or one)(torch.zeros(2, 4, 3))
    torch.func.grad(lambda one: found.append(key(one)) or one.sum())(TENSOR)
    with torch.no_grad(), forward_ad.dual_level():
        found.append(key(forward_ad.make_dual(TENSOR, TENSOR)))
    with FlopCounterMode(display=False):
        found.append(key(TENSOR))
    with torch.autocast("cuda", enabled=True) if torch.cuda.is_available() else torch.autocast("cpu"):
        found.append(key(TENSOR) if torch.is_autocast_enabled() else None)
    with PairCapacity("cpu").step(fixed=False):
        found.append(key(TENSOR))
    assert found == [None] * 6
    assert key(TENSOR) is not None


def test_tensors_by_name_and_in_their_places() -> None:
    """By position, by keyword and in pairs."""
    arguments, options = (TENSOR, None, 3), {"colors": (TENSOR, TENSOR), "backgrounds": TENSOR}
    names = names_of_tensors(["means", "quats", "width"], arguments, options)
    assert names == ["means", "colors", "colors", "backgrounds"]
    assert with_tensors(arguments, options, "abcd") == (["a", None, 3], {"colors": ("b", "c"), "backgrounds": "d"})


@pytest.mark.parametrize(
    ("options", "never"),
    [({"sparse_grad": True}, True), ({"sparse_grad": False}, False), ({"rays": TENSOR}, True), ({"rays": None}, False)],
)
def test_some_arguments_are_never_replayed(options: dict[str, Any], never: bool) -> None:
    """Where they are given, and not their default."""
    assert is_never_replayed(["means"], (TENSOR,), options) is never


def test_transforms_do_what_plain_calls_do(bench: Bench) -> None:
    """The same error, and no replay."""
    bench.warmed_up()
    scene = bench.scene(5)
    others = {name: value for name, value in scene.items() if name != "means"}
    for render in (bench.calls, bench.plain):
        with pytest.raises(UserError, match=r"torch\.func's transforms"):
            torch.func.grad(lambda means, render=render: render(means=means, **others)[0].sum())(scene["means"])
    assert bench.calls.counts.replayed == 0
