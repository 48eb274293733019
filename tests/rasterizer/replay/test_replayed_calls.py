"""When calls are captured, how many are kept, and when the plain call does the work."""

import gc
import os
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch

from forked_processes import run_python
from gaussian_scenes import relative_error
from rasterizer_replays import SEEN, Bench
from thermosplat import rasterization
from thermosplat.rasterizer import replay
from thermosplat.rasterizer.replay import known_signature, replayed_calls

cpu = pytest.mark.parametrize("device", [torch.device("cpu")])


def test_a_signature_is_captured_when_it_was_seen_some_times(bench: Bench) -> None:
    """Another shape has a signature of its own, and comes back to its graph."""
    for n in (50, 60, 50, 60, 50, 60, 50):
        scene = bench.scene(1, n=n)
        assert torch.equal(bench.calls(**scene)[0], bench.plain(**scene)[0])
    assert bench.calls.counts[:3] == (4, 2, 3)


def test_a_frame_without_room_is_rendered_plainly(either_bench: Bench) -> None:
    """Its result is right, backward too; a larger room is captured later, and then it fits."""
    bench, options = either_bench, {"n": 900, "width": 120, "height": 90}

    def scene(size: float) -> dict[str, Any]:
        given = bench.scene(3, **options)
        with torch.no_grad():
            given["scales"].mul_(size)
        return given

    for _ in range(SEEN):
        bench.calls(**scene(0.02))[0].sum().backward()
    assert bench.calls.counts.captured == 1
    for _ in range(SEEN + 2):
        near, again = scene(3.0), scene(3.0)
        image, truth = bench.calls(**near)[0], bench.plain(**again)[0]
        assert torch.equal(image, truth)
        image.square().sum().backward()
        truth.square().sum().backward()
        assert relative_error(near["scales"].grad, again["scales"].grad) < 1e-4
    assert bench.calls.counts.outgrown == 1
    assert bench.calls.counts.captured == 2
    assert bench.calls.counts.replayed == 2


def test_the_room_of_many_pairs_is_tight_until_it_was_too_small(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """An eighth over what was seen; where views differ, half as much again, as few pairs have at once."""
    for many, spares in ((10**9, (1.5, 1.5)), (1, (1.03125, 1.5))):
        monkeypatch.setattr(known_signature, "MANY_PAIRS", many)
        bench.calls.clear()
        for size, spare in zip((0.02, 3.0), spares, strict=True):
            scene = bench.scene(3, n=900, width=120, height=90)
            with torch.no_grad():
                scene["scales"].mul_(size)
            for _ in range(SEEN + 2):
                assert torch.equal(bench.calls(**scene)[0], bench.plain(**scene)[0])
            (signature,) = bench.calls.signatures.values()
            captured = [one() for one in signature.captured]
            assert [one.room.spare for one in captured if one is not None] == [spare]


def test_threads_with_one_signature(bench: Bench) -> None:
    """Each gets its own images and gradients, whatever the others do."""
    scenes = [bench.scene(seed) for seed in range(6)]
    truths = []
    for scene in scenes:
        image = bench.plain(**scene)[0]
        truths.append((image.detach(), torch.autograd.grad(image.square().sum(), scene["means"])[0]))
    together = threading.Barrier(len(scenes))

    def render(k: int) -> bool:
        together.wait()
        good = True
        for _ in range(12):
            image = bench.calls(**scenes[k])[0]
            (gradient,) = torch.autograd.grad(image.square().sum(), scenes[k]["means"])
            good &= torch.equal(image, truths[k][0]) and relative_error(gradient, truths[k][1]) < 1e-4
        return good

    with ThreadPoolExecutor(len(scenes)) as pool:
        assert all(pool.map(render, range(len(scenes))))
    assert bench.calls.counts.replayed > 0
    assert 1 <= bench.calls.counts.captured <= replayed_calls.IN_FLIGHT


@cpu
def test_so_many_renders_may_be_in_flight(bench: Bench, device: torch.device) -> None:
    """More of them are plain."""
    bench.warmed_up()
    for _ in range(2 * replayed_calls.IN_FLIGHT):
        kept = [bench.calls(**bench.scene(k)) for k in range(replayed_calls.IN_FLIGHT + 2)]
        assert all(torch.equal(one[0], bench.plain(**bench.scene(k))[0]) for k, one in enumerate(kept))
    assert bench.calls.counts.captured == replayed_calls.IN_FLIGHT


@cpu
def test_the_least_recently_used_go(bench: Bench, device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there are too many signatures."""
    monkeypatch.setattr(replayed_calls, "SIGNATURES", 2)
    monkeypatch.setattr(replayed_calls, "PAYS", 0)
    for n in (11, 12, 11, 13):
        for _ in range(SEEN + 1):
            bench.calls(**bench.scene(0, n=n))
    kept = [len(one.captured) for one in bench.calls.signatures.values()]
    assert kept == [1, 0, 1]
    assert bench.calls.counts.captured == 3


@cpu
def test_memory_that_is_kept_is_bounded(bench: Bench, device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a share of the device's."""
    monkeypatch.setattr(replayed_calls, "PAYS", 0)
    bench.machine.bytes_of_each, bench.machine.total = 100, 24 * 250
    for n in (11, 12, 13, 14):
        for _ in range(SEEN):
            bench.calls(**bench.scene(0, n=n))
        assert sum(one.bytes for one in bench.calls.signatures.values()) <= 250
    assert [bool(one.captured) for one in bench.calls.signatures.values()] == [False, False, True, True]


@cpu
def test_signatures_that_are_counted_are_bounded(
    bench: Bench, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest is forgotten, of those captured last."""
    monkeypatch.setattr(replayed_calls, "NOTED", 3)
    bench.warmed_up()
    for n in range(60, 70):
        bench.calls(**bench.scene(0, n=n))
        assert len(bench.calls.signatures) <= 3
    bench.calls(**bench.scene(0))
    assert bench.calls.counts.replayed == 1


@cpu
def test_captures_that_do_not_pay_become_rarer(bench: Bench, device: torch.device) -> None:
    """Gaussians are added every few steps: each signature is waited for twice as long as the one before."""
    for n in range(20, 60):
        for _ in range(SEEN + 2):
            bench.calls(**bench.scene(0, n=n))
    assert bench.calls.counts.captured == 3


@cpu
def test_frames_with_much_to_copy_are_plain(bench: Bench, device: torch.device) -> None:
    """They are not limited by the host."""
    bench.machine.most_copied = 1000.0
    for _ in range(SEEN + 3):
        bench.calls(**bench.scene(0))
    assert bench.calls.counts == (SEEN + 3, 0, 0, 0, 0)


@cpu
def test_large_info_is_seldom_copied(bench: Bench, device: torch.device) -> None:
    """Info that somebody holds is copied once, and then plain calls leave the next alone, until some are replayed."""
    image_bytes = 4 * sum(image.numel() for image in bench.plain(**bench.scene(0))[:-1])
    input_bytes = sum(value.nbytes for value in bench.scene(0).values() if isinstance(value, torch.Tensor))
    bench.machine.most_copied = float(image_bytes + input_bytes + 1)

    def replays(seed: int) -> tuple[bool, Any]:
        before = bench.calls.counts.replayed
        info = bench.calls(**bench.scene(seed))[-1]
        return bench.calls.counts.replayed > before, info

    with torch.no_grad():
        for seed in range(SEEN):
            bench.calls(**bench.scene(seed))
        assert all(replays(seed)[0] for seed in range(3))
        _, first = replays(5)
        replayed, second = replays(6)
        assert replayed  # after a copy of the first
        assert not replays(7)[0]
        assert torch.equal(second["depths"], bench.plain(**bench.scene(6))[-1]["depths"])
        assert all(replays(seed)[0] for seed in range(known_signature.COPY_EVERY))
        _, third = replays(8)
        assert replays(9)[0]
        for seed, info in ((5, first), (8, third)):
            assert torch.equal(info["depths"], bench.plain(**bench.scene(seed))[-1]["depths"])


@cpu
@pytest.mark.parametrize("options", [{"sparse_grad": True, "packed": True}, {"with_eval3d": True}])
def test_arguments_that_are_never_replayed(bench: Bench, device: torch.device, options: dict[str, Any]) -> None:
    """Their calls are plain."""
    for _ in range(SEEN + 3):
        bench.calls(**(bench.scene(0) | options))
    assert bench.calls.counts == (SEEN + 3, 0, 0, 0, 0)


@cpu
def test_a_capture_that_fails_costs_nothing_but_itself(
    bench: Bench, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The call gives its result, and is not tried again."""

    def broken(self: Any, device: torch.device) -> Any:
        raise torch.OutOfMemoryError("no memory for a graph")

    monkeypatch.setattr(type(bench.machine), "recorder", broken)
    for _ in range(SEEN + 3):
        scene = bench.scene(0)
        assert torch.equal(bench.calls(**scene)[0], bench.plain(**scene)[0])
    assert bench.calls.counts == (SEEN + 3, 0, 0, 0, 1)


@cpu
def test_mistakes_are_told_as_ever(bench: Bench, device: torch.device) -> None:
    """And leave no trace."""
    bench.warmed_up()
    for _ in range(SEEN + 2):
        with pytest.raises(ValueError, match="means must have shape"):
            bench.calls(**bench.scene(0) | {"means": torch.zeros(50, 4)})
    bench.calls(**bench.scene(0))
    assert bench.calls.counts.replayed == 1


@cpu
def test_another_place_has_other_graphs(bench: Bench, device: torch.device) -> None:
    """A stream keeps its own; where there is no place, calls are plain."""
    bench.warmed_up()
    for bench.machine.where in ("another stream", None):
        for _ in range(SEEN + 1):
            bench.calls(**bench.scene(0))
    assert bench.calls.counts.captured == 2
    assert bench.calls.counts.replayed == 1


@cpu
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_nothing(bench: Bench, device: torch.device) -> None:
    """What its parent captured is neither used nor destroyed there."""
    bench.warmed_up()
    captured = [weakref.ref(one) for one in bench.calls.signatures.values()]
    bench.calls.turn.acquire()  # as if another thread captured
    child = os.fork()
    if child == 0:
        empty = not bench.calls.signatures and not bench.calls.turn.locked()
        gc.collect()
        os._exit(0 if empty and captured and all(one() is not None for one in captured) else 1)
    bench.calls.turn.release()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    bench.calls(**bench.scene(0))
    assert bench.calls.counts.replayed == 1


@cpu
def test_clearing_lets_go_of_everything(bench: Bench, device: torch.device) -> None:
    """What is in flight still has its backward pass."""
    bench.warmed_up()
    scene = bench.scene(5)
    image = bench.calls(**scene)[0]
    replay.clear()
    assert not bench.calls.signatures
    image.sum().backward()
    truth = torch.autograd.grad(bench.plain(**scene)[0].sum(), scene["means"])[0]
    assert relative_error(scene["means"].grad, truth) < 1e-4


def test_the_switch() -> None:
    """Off: the public functions are what they were. The environment decides how a program starts."""
    was = replay.is_enabled()
    try:
        for on in (True, False):
            replay.enable(on)
            before = replay.counts()["rasterization"].plain
            rasterization(**Bench(torch.device("cpu")).scene(0))
            assert replay.counts()["rasterization"].plain == before + on
    finally:
        replay.enable(was)
    code = """
import importlib, os
from thermosplat.rasterizer.replay import replayed_calls
for value in ("0", "1", None):
    os.environ.pop("THERMOSPLAT_REPLAY", None)
    if value is not None:
        os.environ["THERMOSPLAT_REPLAY"] = value
    print(importlib.reload(replayed_calls).is_enabled())
"""
    assert run_python("-c", code).stdout.split() == ["False", "True", "True"]
