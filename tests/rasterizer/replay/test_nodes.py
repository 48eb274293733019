"""What people do to torch's graph does the same to a replayed call as to a plain one."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gaussian_scenes import relative_error
from rasterizer_replays import Bench


def gradients_of(loss: Tensor, scene: dict[str, Any], names: tuple[str, ...] = ("means", "scales", "colors")) -> Any:
    """Of a loss, to some leaves."""
    return torch.autograd.grad(loss, [scene[name] for name in names])


def assert_near(found: Any, expected: Any) -> None:
    """Gradients are nearly the same, and not zero."""
    for ours, theirs in zip(found, expected, strict=True):
        assert theirs.norm() > 0
        assert relative_error(ours, theirs) < 1e-4


def test_renders_in_flight(either_bench: Bench) -> None:
    """Several wait for their backward pass, which come in another order; each has a captured call of its own."""
    bench = either_bench.warmed_up()
    for _ in range(4):
        scenes = [bench.scene(seed) for seed in range(5, 8)]
        losses = [bench.calls(**scene)[0].square().sum() for scene in scenes]
        found = [gradients_of(losses[k], scenes[k]) for k in (1, 2, 0)]
        expected = [gradients_of(bench.plain(**scenes[k])[0].square().sum(), scenes[k]) for k in (1, 2, 0)]
        for ours, theirs in zip(found, expected, strict=True):
            assert_near(ours, theirs)
    assert bench.calls.counts.captured == 3
    assert bench.calls.counts.replayed >= 6


def test_losses_of_several_renders_are_added(bench: Bench) -> None:
    """One backward pass through two renders of the same leaves."""
    bench.warmed_up()
    scene = bench.scene(5)

    def loss(render: Any) -> Tensor:
        return render(**scene)[0].square().sum() * render(**scene)[1].sum()

    for _ in range(4):
        assert_near(gradients_of(loss(bench.calls), scene), gradients_of(loss(bench.plain), scene))
    assert bench.calls.counts.captured == 2


def test_a_second_backward_pass(bench: Bench) -> None:
    """Is the first again where torch keeps the graph, and an error otherwise."""
    bench.warmed_up()
    scene = bench.scene(5)
    loss = bench.calls(**scene)[0].square().sum()
    first = torch.autograd.grad(loss, scene["means"], retain_graph=True)[0]
    kept = first.clone()
    bench.calls(**bench.scene(6))  # while the other is in flight
    second = torch.autograd.grad(loss, scene["means"])[0]
    assert torch.equal(first, kept)
    assert relative_error(second, first) < 1e-4
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(loss, scene["means"])


def test_a_captured_call_is_free_when_it_can_no_longer_be_differentiated(bench: Bench) -> None:
    """After the backward pass, though images are kept; when images are dropped without one; not before."""
    bench.warmed_up()
    (signature,) = bench.calls.signatures.values()
    kept = bench.calls(**bench.scene(5))
    assert len(signature.free) == 0
    kept[0].sum().backward(retain_graph=True)
    assert len(signature.free) == 0
    kept[0].sum().backward()
    assert len(signature.free) == 1
    dropped = bench.calls(**bench.scene(6))
    assert len(signature.free) == 0
    del dropped
    assert len(signature.free) == 1
    assert bench.calls.counts.replayed == 2


def test_half_a_backward_pass(bench: Bench) -> None:
    """To means2d alone, then on from there: the projection's half is differentiated by itself."""
    bench.warmed_up()
    scene = bench.scene(5)
    found = []
    for render in (bench.calls, bench.plain):
        image, _, info = render(**scene)
        (to_means2d,) = torch.autograd.grad(image.square().sum(), info["means2d"], retain_graph=True)
        found.append([to_means2d, *gradients_of(info["means2d"].sin().sum(), scene, ("means", "viewmats"))])
    assert_near(*found)
    assert bench.calls.counts.replayed == 1


def test_hooks(bench: Bench) -> None:
    """On means2d, where they may change the gradient, in place too; on leaves; on the image."""
    bench.warmed_up()
    results = []

    def in_place(gradient: Tensor) -> None:
        gradient[..., 0].mul_(0.25)

    for render in (bench.calls, bench.plain):
        scene = bench.scene(5)
        seen: list[Tensor] = []
        scene["means"].register_hook(lambda gradient, seen=seen: seen.append(gradient))
        image, _, info = render(**scene)
        info["means2d"].register_hook(lambda gradient, seen=seen: seen.append(gradient.clone()))
        info["means2d"].register_hook(lambda gradient: gradient * 3.0)
        info["means2d"].register_hook(in_place)
        image.register_hook(lambda gradient: gradient * 0.5)
        image.square().sum().backward()
        results.append([*seen, scene["means"].grad, scene["viewmats"].grad])
    assert len(results[0]) == 4
    assert_near(*results)


def test_threads_differentiate_one_render(bench: Bench) -> None:
    """Each gets its own gradients, since torch keeps the graph."""
    bench.warmed_up()
    scene = bench.scene(5)
    image = bench.calls(**scene)[0]
    truth = bench.plain(**scene)[0]
    upstreams = [torch.full_like(image, 1.0 + k).requires_grad_(False) for k in range(4)]
    expected = [torch.autograd.grad(truth, scene["means"], one, retain_graph=True)[0] for one in upstreams]

    def differentiate(k: int) -> bool:
        return all(
            relative_error(torch.autograd.grad(image, scene["means"], upstreams[k], retain_graph=True)[0], expected[k])
            < 1e-4
            for _ in range(10)
        )

    with ThreadPoolExecutor(len(upstreams)) as pool:
        assert all(pool.map(differentiate, range(len(upstreams))))
    assert bench.calls.counts.replayed == 1


def test_second_derivatives(bench: Bench) -> None:
    """An error where a plain call has one, and also where that takes gradients for constants; never a wrong number."""
    bench.warmed_up()
    for render in (bench.calls, bench.plain):
        for power in (1, 2):  # with a background none is linear
            scene = bench.scene(5)
            loss = render(**scene)[0].pow(power).sum()
            (gradient,) = torch.autograd.grad(loss, scene["means"], create_graph=True)
            with pytest.raises(RuntimeError, match="differentiate twice"):
                gradient.square().sum().backward()
    assert bench.calls.counts.replayed >= 1


def test_changes_between_forward_and_backward_pass(bench: Bench) -> None:
    """A leaf that was changed in place is refused, as a plain call refuses it."""
    bench.warmed_up()
    for render in (bench.calls, bench.plain):
        scene = bench.scene(5)
        loss = render(**scene)[0].square().sum()
        with torch.no_grad():
            scene["scales"].mul_(2.0)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            loss.backward()
    assert bench.calls.counts.replayed == 1


def test_checkpoints_and_hooks_on_saved_tensors_get_plain_calls(bench: Bench) -> None:
    """Recomputing counts what was saved: both passes are plain."""
    bench.warmed_up()
    plain = bench.calls.counts.plain
    scene = bench.scene(5)
    others = {name: value for name, value in scene.items() if name != "means"}
    image = checkpoint(lambda means: bench.calls(means=means, **others)[0], scene["means"], use_reentrant=False)
    found = gradients_of(image.square().sum(), scene)
    with torch.autograd.graph.save_on_cpu():
        again = bench.calls(**scene)[0]
    expected = gradients_of(bench.plain(**scene)[0].square().sum(), scene)
    assert_near(found, expected)
    assert_near(gradients_of(again.square().sum(), scene), expected)
    assert bench.calls.counts.replayed == 0
    assert bench.calls.counts.plain == plain + 3


def test_gradients_may_be_accumulated(bench: Bench) -> None:
    """``.grad`` is memory of its own: torch adds to it in place, over many replays."""
    bench.warmed_up()
    scene = bench.scene(5)
    for _ in range(3):
        bench.calls(**scene)[0].square().sum().backward()
    (once,) = gradients_of(bench.plain(**scene)[0].square().sum(), scene, ("means",))
    assert bench.calls.counts.replayed == 3
    assert relative_error(scene["means"].grad, 3.0 * once) < 1e-4
