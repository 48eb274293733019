"""A render is captured with torch's own means and replayed on other numbers."""

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor

from gaussian_scenes import leaves, random_rgbt_scene, random_scene, relative_error, upstream_gradients
from thermosplat import PairCapacity, UserError, rasterization, rasterization_rgbt
from thermosplat.rasterizer import projected_scene

SIZE = {"width": 120, "height": 90}

cuda = pytest.mark.cuda


@pytest.fixture
def gpu() -> torch.device:
    """A CUDA device."""
    return torch.device("cuda")


class Step:
    """Images and the gradients of all leaves, for gradients of the images that stay the same.

    Args:
        scene: Arguments of a rasterization.
        device: Where it runs.
        rgbt: ``rasterization_rgbt`` instead of ``rasterization``.
        deterministic: As there.
    """

    def __init__(self, scene: dict[str, Any], device: torch.device, rgbt: bool = False, deterministic: bool = False):
        self.inputs = leaves(scene, device, torch.float32) | {"deterministic": deterministic}
        self.leaves = [v for v in self.inputs.values() if isinstance(v, Tensor) and v.requires_grad]
        self.function = rasterization_rgbt if rgbt else rasterization
        ones = torch.ones(1, scene["height"], scene["width"])
        self.upstream = [up.to(device, torch.float32) for up in upstream_gradients(self.images(), ones)]

    def images(self) -> list[Tensor]:
        """The images alone."""
        return [image for image in self.function(**self.inputs)[:-1] if image is not None]

    def __call__(self) -> list[Tensor]:
        """Images and gradients."""
        images = self.images()
        return [*images, *torch.autograd.grad(images, self.leaves, self.upstream)]

    def measured(self, device: torch.device) -> PairCapacity:
        """Room for the step, which runs on a stream of its own as warming up for a capture should."""
        capacity, stream = PairCapacity(device), torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                with capacity.step(fixed=False):
                    self()
        torch.cuda.current_stream().wait_stream(stream)
        capacity.measure()
        return capacity


def _move(step: Step) -> None:
    """Changes the inputs in place: the camera steps back a little, and the Gaussians turn brighter."""
    with torch.no_grad():
        step.inputs["viewmats"][..., 2, 3] += 0.1
        step.inputs["colors"].mul_(1.3)


def _assert_same(found: list[Tensor], expected: list[Tensor], exactly: bool = False) -> None:
    for ours, theirs in zip(found, expected, strict=True):
        assert theirs.norm() > 0
        assert torch.equal(ours, theirs) if exactly else relative_error(ours, theirs) < 1e-5


@cuda
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("rgbt", [False, True])
def test_a_captured_render_is_the_eager_one(gpu: torch.device, rgbt: bool, deterministic: bool) -> None:
    """Images and gradients of a replay are those of a call, also after the inputs changed."""
    scene = random_rgbt_scene(n=400, **SIZE) if rgbt else random_scene(n=400, **SIZE)
    step = Step(scene, gpu, rgbt, deterministic)
    capacity, graph = step.measured(gpu), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph), capacity.step(fixed=True):
        results = step()
    for _ in range(3):
        graph.replay()
        _assert_same([result.clone() for result in results], step(), exactly=deterministic)
        _move(step)
    capacity.check()


@cuda
def test_forward_alone_and_two_renders_in_one_graph(gpu: torch.device) -> None:
    """Without gradients; each rasterization of the step has its room."""
    near, far = (Step(random_scene(n=n, **SIZE), gpu) for n in (300, 900))
    capacity, graph = PairCapacity(gpu), torch.cuda.CUDAGraph()
    with torch.no_grad():
        with capacity.step(fixed=False):
            expected = near.images() + far.images()
        capacity.measure()
        with torch.cuda.graph(graph), capacity.step(fixed=True):
            images = near.images() + far.images()
    graph.replay()
    _assert_same(images, expected, exactly=True)


@cuda
def test_make_graphed_callables(gpu: torch.device) -> None:
    """Torch's wrapper captures forward and backward apart; a module built on the render trains through it."""
    step = Step(random_scene(n=300, **SIZE), gpu)
    capacity = step.measured(gpu)
    names = ("means", "colors")

    def render(means: Tensor, colors: Tensor) -> tuple[Tensor, Tensor]:
        with capacity.step(fixed=True):
            image, alphas, _ = rasterization(**step.inputs | {"means": means, "colors": colors})
        return image, alphas

    samples = tuple(step.inputs[name].detach().clone().requires_grad_() for name in names)
    graphed = torch.cuda.make_graphed_callables(render, samples)
    inputs = [(step.inputs[name] * 1.05).detach().requires_grad_() for name in names]
    results = []
    for function in (graphed, render):
        images = function(*inputs)
        gradients = torch.autograd.grad(images, inputs, step.upstream)
        results.append([tensor.detach().clone() for tensor in (*images, *gradients)])
    _assert_same(*results)


@cuda
def test_what_does_not_fit_is_told(gpu: torch.device) -> None:
    """A replay with more pairs than room says so, stays finite, and fits again afterwards."""
    step = Step(random_scene(n=2000, **SIZE), gpu)
    with torch.no_grad():
        step.inputs["scales"].mul_(0.2)
    capacity, graph = step.measured(gpu), torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph), capacity.step(fixed=True):
        results = step()
    graph.replay()
    assert capacity.overflow == 0
    with torch.no_grad():
        step.inputs["scales"].mul_(20.0)
    graph.replay()
    assert capacity.overflow == 1
    assert all(torch.isfinite(result).all() for result in results)
    with pytest.raises(UserError, match="room for"):
        capacity.check()
    with torch.no_grad():
        step.inputs["scales"].div_(20.0)
    graph.replay()
    assert capacity.overflow == 0
    _assert_same([result.clone() for result in results], step())


@cuda
def test_a_capture_without_room_is_refused(gpu: torch.device) -> None:
    """A sentence that names PairCapacity, not a CUDA error; the device works afterwards."""
    step = Step(random_scene(n=300, **SIZE), gpu)
    expected = step()
    with pytest.raises(UserError, match="cannot capture") as raised, torch.cuda.graph(torch.cuda.CUDAGraph()):
        step()
    assert "PairCapacity" in str(raised.value.hint)
    _assert_same(step(), expected)


def test_a_capture_without_room_is_refused_before_anything_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same where there is no GPU, for the sentence's sake."""
    monkeypatch.setattr(projected_scene, "joined_capture", lambda device: nullcontext(True))
    inputs = leaves(random_scene(n=20), torch.device("cpu"), torch.float32)
    with pytest.raises(UserError, match="reads its number of"):
        rasterization(**inputs)
    capacity = PairCapacity("cpu")
    capacity.measure()
    with capacity.step(fixed=True):
        rasterization(**inputs)
    capacity.check()
