"""A replayed call gives what the plain one gives: images, gradients and info, of whatever was asked for."""

import gc
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from gaussian_scenes import Scene, relative_error
from rasterizer_replays import SEEN, Bench, images_of
from thermosplat.rasterizer.replay import known_signature

pytestmark = pytest.mark.rotating

VARIANTS: dict[str, dict[str, Any]] = {
    "colors": {},
    "harmonics": {"sh_degree": 3},
    "cameras": {"cameras": 2, "per_camera_colors": True},
    "scenes": {"batch": (2,)},
    "antialiased": {"rasterize_mode": "antialiased"},
    "absgrad": {"absgrad": True},
    "deterministic": {"deterministic": True},
    "many channels": {"channels": 37},
    "no background": {"backgrounds": False},
}
OF_ONE_OPACITY: dict[str, dict[str, Any]] = {
    "depth": {"render_mode": "RGB+ED"},
    "distance": {"render_mode": "D", "global_z_order": False},
    "covariances": {"with_covars": True},
}


def results(render: Any, scene: Scene) -> tuple[list[Tensor], dict[str, Tensor | None], Any]:
    """Images, gradients of all leaves and of means2d, and info."""
    found = render(**scene)
    info, images = found[-1], images_of(found)
    info["means2d"].retain_grad()
    sum(image.square().sum() for image in images).backward()
    gradients = {name: value.grad for name, value in scene.items() if isinstance(value, Tensor)}
    gradients["means2d"] = info["means2d"].grad
    gradients["absgrad"] = getattr(info["means2d"], "absgrad", None)
    return images, gradients, info


def fresh(scene: Scene) -> Scene:
    """The same leaves without gradients."""
    return {
        name: value.detach().clone().requires_grad_(value.requires_grad) if isinstance(value, Tensor) else value
        for name, value in scene.items()
    }


def assert_same(found: Any, expected: Any) -> None:
    """Images to the last bit, gradients nearly, every entry of info."""
    for image, truth in zip(found[0], expected[0], strict=True):
        assert truth.norm() > 0
        assert torch.equal(image, truth)
        assert image.shape == truth.shape
        assert image.requires_grad == truth.requires_grad
    for name, truth in expected[1].items():
        if truth is None:
            assert found[1][name] is None, name
        else:
            assert relative_error(found[1][name], truth) < 1e-4, name
    assert set(found[2]) == set(expected[2])
    for key, truth in expected[2].items():
        value = found[2][key]
        if isinstance(truth, Tensor):
            assert value.dtype == truth.dtype, key
            assert value.requires_grad == truth.requires_grad, key
            torch.testing.assert_close(value.detach(), truth.detach(), rtol=0, atol=0)
        else:
            assert value == truth, key


@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS)
def test_a_replay_is_the_plain_call(either_bench: Bench, options: dict[str, Any]) -> None:
    """On other numbers than those it was captured with."""
    bench = either_bench.warmed_up(**options)
    for seed in (11, 12):
        scene = bench.scene(seed, **options)
        assert_same(results(bench.calls, scene), results(bench.plain, fresh(scene)))
    assert bench.calls.counts.replayed == 2


@pytest.mark.parametrize("options", OF_ONE_OPACITY.values(), ids=OF_ONE_OPACITY)
def test_a_replay_of_other_modes(bench: Bench, options: dict[str, Any]) -> None:
    """Depths, distances and covariances."""
    bench.warmed_up(**options)
    scene = bench.scene(11, **options)
    assert_same(results(bench.calls, scene), results(bench.plain, fresh(scene)))
    assert bench.calls.counts.replayed == 1


@pytest.mark.parametrize("names", [["means"], ["colors"], ["opacities"], ["backgrounds"], ["viewmats", "colors"]])
def test_gradients_to_some_tensors_alone(bench: Bench, names: list[str]) -> None:
    """The others stay constants; what passes from projection to blending is another set each time."""
    if not set(names) <= set(bench.scene()):
        pytest.skip("needs a background")

    def scene(seed: int) -> Scene:
        given = bench.scene(seed)
        for name, value in given.items():
            if isinstance(value, Tensor):
                value.requires_grad_(name in names)
        return given

    found: list[Tensor] = []
    expected: list[Tensor] = []
    moves: list[bool] = []
    for seed in range(SEEN + 1):
        inputs = scene(seed)
        for render, kept in ((bench.calls, found), (bench.plain, expected)):
            images, _, info = render(**inputs)
            gradients = torch.autograd.grad(images.square().sum(), [inputs[name] for name in names])
            kept[:] = [images.detach(), *gradients]
            moves.append(info["means2d"].requires_grad)
    assert moves[-1] is moves[-2] is (names in (["means"], ["viewmats", "colors"]))
    assert bench.calls.counts.replayed == 1
    assert all(relative_error(ours, theirs) < 1e-4 for ours, theirs in zip(found, expected, strict=True))


def test_extra_signals_and_pairs_of_coefficients(bench: Bench) -> None:
    """An image in info, and coefficients in two tensors."""
    options = {"sh_degree": 2, "backgrounds": False}

    def inputs(seed: int) -> Scene:
        scene = bench.scene(seed, **options)
        coefficients = scene.pop("colors").detach()
        scene["sh0"], scene["shN"] = (part.clone().requires_grad_() for part in coefficients.split([1, 8], -2))
        scene["signals"] = torch.rand(50, 2, device=bench.device, requires_grad=True)
        return scene

    def through(render: Any) -> Any:
        return lambda sh0, shN, signals, **rest: render(colors=(sh0, shN), extra_signals=signals, **rest)

    for seed in range(SEEN):
        results(through(bench.calls), inputs(seed))
    scene = inputs(9)
    assert_same(results(through(bench.calls), scene), results(through(bench.plain), fresh(scene)))
    assert bench.calls.counts.replayed == 1


@pytest.mark.parametrize("first", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("then", [torch.no_grad, torch.inference_mode])
def test_without_gradients(either_bench: Bench, first: Any, then: Any) -> None:
    """Nothing is saved, and the captured call is free again at once; inference mode has the same graphs."""
    bench = either_bench
    for seed in range(SEEN + 3):
        with first() if seed < SEEN else then():
            scene = bench.scene(seed)
            found, expected = bench.calls(**scene), bench.plain(**scene)
            for image, truth in zip(images_of(found), images_of(expected), strict=True):
                assert torch.equal(image, truth)
                assert not image.requires_grad
    assert bench.calls.counts.captured == 1
    assert bench.calls.counts.replayed == 3


def test_results_belong_to_the_caller(bench: Bench) -> None:
    """Images, gradients and info stay as they are while later calls are replayed, and may be changed in place."""
    bench.warmed_up()
    kept = []
    for seed in range(20, 24):
        scene = bench.scene(seed)
        kept.append((results(bench.calls, scene), results(bench.plain, fresh(scene))))
    for found, expected in kept:
        assert_same(found, expected)
        found[0][0].data.zero_()
    assert bench.calls.counts.replayed == 4
    scene = bench.scene(30)
    image, _, _ = bench.calls(**scene)
    (image.mul_(2.0)).sum().backward()
    again = fresh(scene)
    (2.0 * bench.plain(**again)[0]).sum().backward()
    assert relative_error(scene["means"].grad, again["means"].grad) < 1e-4


LOSSES: dict[str, Callable[[list[Tensor]], Tensor]] = {
    "expanded": lambda images: images[0].sum(),
    "transposed": lambda images: images[0].transpose(-2, -3).contiguous().square().sum(),
    "of some channels": lambda images: images[0][..., 1:].square().sum() + images[0][..., :1].sum(),
    "to one image alone": lambda images: images[-1].square().sum(),
    "to all": lambda images: torch.cat(images, -1).square().sum(),
}


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_gradients_of_every_kind(either_bench: Bench, loss: Callable[[list[Tensor]], Tensor]) -> None:
    """They are read where they lie, or copied, or are zeros; those of the call before are not read."""
    bench = either_bench.warmed_up()
    for seed in range(3):
        scene = bench.scene(seed)
        again = fresh(scene)
        sum(image.sum() for image in images_of(bench.calls(**bench.scene(9)))).backward()
        loss(images_of(bench.calls(**scene))).backward()
        loss(images_of(bench.plain(**again))).backward()
        for name, value in scene.items():
            if isinstance(value, Tensor):
                truth = again[name].grad
                if truth is None:  # zeros stand for it where a graph was recorded with a gradient
                    assert value.grad is None or not value.grad.any(), name
                else:
                    assert relative_error(value.grad, truth) < 1e-4, name
    assert bench.calls.counts.replayed == 6


def test_tensors_of_other_strides(bench: Bench) -> None:
    """Transposed memory has the same signature and the same result."""
    bench.warmed_up()
    scene = bench.scene(9)
    turned = {**scene, "means": scene["means"].detach().t().contiguous().t().requires_grad_()}
    assert not turned["means"].is_contiguous()
    assert torch.equal(bench.calls(**turned)[0], bench.plain(**scene)[0])
    assert bench.calls.counts.replayed == 1


def test_large_tensors_are_read_where_they_lie(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parameters are not copied; one that comes from elsewhere is noticed, and copied from then on."""
    monkeypatch.setattr(known_signature, "BOUND_BYTES", 1)
    scene = bench.scene(0)
    for _ in range(SEEN):
        results(bench.calls, scene)
    with torch.no_grad():
        scene["means"].mul_(1.1)
        scene["viewmats"][..., 2, 3] += 0.1
    found = bench.calls(**scene)
    assert torch.equal(found[0], bench.plain(**scene)[0])
    assert bench.calls.counts.replayed == 1
    for elsewhere in range(1, SEEN + 2):
        moved = bench.scene(elsewhere)
        scene |= {"means": moved["means"]}
        again = fresh(scene)
        assert_same(results(bench.calls, fresh(scene)), results(bench.plain, again))
    assert bench.calls.counts.captured == 2
    assert bench.calls.counts.replayed == 2


@pytest.mark.cuda
def test_tensors_are_let_go_of() -> None:
    """Nothing that was given, read where it lies or copied, is kept by what was captured or by a call that is over."""
    bench = Bench(torch.device("cuda"))
    scene = bench.scene(0, n=100_000)
    for _ in range(SEEN + 2):
        bench.calls(**scene)[0].sum().backward()
    assert bench.calls.counts.replayed == 2
    kept = [weakref.ref(value) for value in scene.values() if isinstance(value, Tensor)]
    before = torch.cuda.memory_allocated()
    held = sum(value.nbytes for value in scene.values() if isinstance(value, Tensor))
    scene.clear()
    gc.collect()
    assert all(one() is None for one in kept)
    assert torch.cuda.memory_allocated() <= before - held


def test_inputs_may_be_gone_before_the_backward_pass(bench: Bench) -> None:
    """What is not a leaf lives as long as it is read; its memory is not given to others before."""
    bench.warmed_up()

    def image(render: Any, scene: Scene) -> Tensor:
        return render(**scene | {"means": scene["means"] * 1.0, "scales": scene["scales"] + 0.0})[0]

    scene = bench.scene(7)
    ours = image(bench.calls, scene)
    noise = [torch.randn(50, 3, device=bench.device) for _ in range(4)]
    ours.square().sum().backward()
    again = fresh(scene)
    image(bench.plain, again).square().sum().backward()
    assert bench.calls.counts.replayed == 1
    assert all(relative_error(scene[name].grad, again[name].grad) < 1e-4 for name in ("means", "scales", "colors"))
    del noise
