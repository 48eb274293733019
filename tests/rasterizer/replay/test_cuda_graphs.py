"""What only a device can show: captures of others, streams, memory, compiled callers."""

import gc
from typing import Any

import pytest
import torch

from gaussian_scenes import relative_error
from rasterizer_replays import SEEN, Bench
from thermosplat import PairCapacity
from thermosplat.rasterizer.replay import machine, replayed_calls

pytestmark = pytest.mark.cuda


@pytest.fixture
def gpu_bench() -> Bench:
    """Of ``rasterization`` on CUDA."""
    return Bench(torch.device("cuda"))


def test_captures_of_others_hold_plain_calls(gpu_bench: Bench) -> None:
    """Inside torch.cuda.graph, and in a step of PairCapacity, nothing is replayed."""
    bench = gpu_bench.warmed_up()
    scene, capacity, graph = bench.scene(5), PairCapacity("cuda"), torch.cuda.CUDAGraph()
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.no_grad(), torch.cuda.stream(stream):
        for _ in range(3):
            with capacity.step(fixed=False):
                bench.calls(**scene)
    torch.cuda.current_stream().wait_stream(stream)
    capacity.measure()
    with torch.no_grad(), torch.cuda.graph(graph), capacity.step(fixed=True):
        image = bench.calls(**scene)[0]
    with torch.no_grad():
        scene["means"].mul_(1.1)
        graph.replay()
        assert torch.equal(image, bench.plain(**scene)[0])
    assert bench.calls.counts.replayed == 0


def test_streams_have_their_own(gpu_bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """A render on another stream waits for nothing of this one, and disturbs nothing."""
    monkeypatch.setattr(replayed_calls, "PAYS", 0)
    bench = gpu_bench.warmed_up()
    streams = [torch.cuda.Stream() for _ in range(2)]
    scenes = [bench.scene(seed, n=50) for seed in (5, 6)]
    truths = [bench.plain(**scene)[0].detach() for scene in scenes]
    torch.cuda.synchronize()
    images: list[list[Any]] = [[], []]
    for _ in range(SEEN + 10):
        for stream, scene, kept in zip(streams, scenes, images, strict=True):
            with torch.cuda.stream(stream):
                torch.cuda._sleep(100_000)
                image = bench.calls(**scene)[0]
                image.square().sum().backward()
                kept.append(image.detach())
    torch.cuda.synchronize()
    for kept, truth in zip(images, truths, strict=True):
        assert all(torch.equal(image, truth) for image in kept)
    assert bench.calls.counts.captured == 3
    assert bench.calls.counts.replayed == 20


def test_memory_does_not_grow(gpu_bench: Bench) -> None:
    """Over many replays, and over captures that are let go of."""
    bench = gpu_bench.warmed_up()

    def render(n: int, times: int) -> int:
        for seed in range(times):
            scene = bench.scene(seed, n=n)
            bench.calls(**scene)[0].square().sum().backward()
        del scene
        gc.collect()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        return torch.cuda.memory_reserved()

    first = render(50, 20)
    assert render(50, 200) <= first
    sizes = []
    for n in range(100, 112):
        render(n, SEEN + 1)
        bench.calls.clear()
        gc.collect()
        torch.cuda.empty_cache()
        sizes.append(torch.cuda.memory_reserved())
    assert sizes[-1] <= sizes[3]


def test_large_scenes_in_turns_with_small_ones(gpu_bench: Bench) -> None:
    """Parameters that are read where they lie, cameras that are copied; others use the device in between."""
    bench = gpu_bench
    options = {"n": 40_000, "width": 320, "height": 200, "sh_degree": 3}
    scene = bench.scene(0, **options)
    with torch.no_grad():
        scene["scales"].mul_(0.1)
    optimizer = torch.optim.SGD([scene[name] for name in ("means", "colors", "opacities")], lr=1e-6)
    for step in range(12):
        viewmats = scene["viewmats"].detach().clone()
        viewmats[..., 2, 3] += 0.1 * step
        results = []
        for render in (bench.calls, bench.plain):
            optimizer.zero_grad()
            scene["scales"].grad = None
            image, alphas, _ = render(**scene | {"viewmats": viewmats})
            (image.square().sum() + alphas.sum()).backward()
            results.append([image.detach(), *[scene[name].grad.clone() for name in ("means", "colors", "scales")]])
            torch.randn(10_000_000, device="cuda").sum()
        optimizer.step()
        assert torch.equal(results[0][0], results[1][0])
        assert all(relative_error(ours, theirs) < 1e-4 for ours, theirs in zip(*results, strict=True))
    assert bench.calls.counts.replayed >= 8
    assert bench.calls.counts.failed == 0


def test_compiled_callers(gpu_bench: Bench) -> None:
    """Code that torch compiles calls the rasterizer as it is; what is replayed inside is the same."""
    bench = gpu_bench
    render = torch.compiler.disable(bench.calls.__call__)
    scene = bench.scene(5)

    def bright(gain: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(render(**scene | {"colors": scene["colors"] * gain})[0] * 2.0)

    compiled = torch.compile(bright, backend="aot_eager")
    for k in range(SEEN + 4):
        gain = torch.tensor(1.0 + 0.1 * k, device="cuda", requires_grad=True)
        (found,) = torch.autograd.grad(compiled(gain).square().sum(), gain)
        truth = torch.sigmoid(bench.plain(**scene | {"colors": scene["colors"] * gain})[0] * 2.0)
        (expected,) = torch.autograd.grad(truth.square().sum(), gain)
        assert relative_error(found, expected) < 1e-4
    assert bench.calls.counts.replayed >= 2


def test_a_large_share_of_the_copies_limits_what_is_replayed(gpu_bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The device's speed is measured, and decides."""
    monkeypatch.setattr(machine, "COPIES_WITH_GRADIENTS_MS", 1e-9)
    for _ in range(SEEN + 2):
        gpu_bench.calls(**gpu_bench.scene(0))
    assert gpu_bench.calls.counts == (SEEN + 2, 0, 0, 0, 0)
