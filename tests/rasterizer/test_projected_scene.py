"""What the renders of one projection share: the tensors in info lie on the gradient's path."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

import reference_rasterizer
from gaussian_scenes import leaves, random_rgbt_scene, random_scene, relative_error
from thermosplat import rasterization, rasterization_rgbt


@pytest.mark.parametrize("render_mode", ["D", "RGB+D"])
def test_depths_retain_their_gradient(device: torch.device, render_mode: str) -> None:
    """info["depths"].grad is the gradient of the same depths rendered as colours."""
    scene = random_scene(cameras=2, render_mode=render_mode, backgrounds=False)
    image, _, info = rasterization(**leaves(scene, device, torch.float64), packed=False)
    info["depths"].retain_grad()
    upstream = torch.randn(*image.shape[:-1], 1, generator=torch.Generator().manual_seed(3)).double()
    (image[..., -1:] * upstream.to(image)).sum().backward()

    colors = info["depths"].detach().cpu().unsqueeze(-1).requires_grad_()
    drawn, _, _ = reference_rasterizer.rasterization(**scene | {"colors": colors, "render_mode": "RGB"})
    (drawn * upstream).sum().backward()
    assert colors.grad.norm() > 0
    assert info["depths"].grad.shape == (2, 60)
    assert relative_error(info["depths"].grad.cpu(), colors.grad[..., 0]) < 1e-11


@pytest.mark.parametrize("sh_degree", [None, 2])
@pytest.mark.parametrize("keep", ["copies", "checkpoint"])
def test_what_is_saved_may_come_back_elsewhere(device: torch.device, keep: str, sh_degree: int | None) -> None:
    """Gradients are the same where torch moves what the backward pass reads, or makes it again."""
    inputs = leaves(random_rgbt_scene(cameras=2, sh_degree=sh_degree), device, torch.float64)
    names = [name for name, value in inputs.items() if isinstance(value, torch.Tensor) and value.requires_grad]

    def render() -> torch.Tensor:
        return torch.cat(rasterization_rgbt(**inputs)[:5], -1)

    def gradients(image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        torch.full((1_000_000,), torch.nan, device=image.device)  # where memory was given back
        return torch.autograd.grad(image.square().sum(), [inputs[name] for name in names])

    expected = gradients(render())
    if keep == "copies":
        with torch.autograd.graph.saved_tensors_hooks(torch.clone, lambda tensor: tensor):
            image = render()
    else:
        image = checkpoint(render, use_reentrant=False)
    for name, one, other in zip(names, expected, gradients(image), strict=True):
        assert one.norm() > 0, name
        assert relative_error(other, one) < 1e-12, name


def test_a_graph_may_be_walked_again_for_other_inputs(device: torch.device) -> None:
    """Nothing of one backward pass is left for the next: not the loss's gradients, nor where gradients went."""
    inputs = leaves(random_rgbt_scene(cameras=2, sh_degree=1), device, torch.float64)
    images = rasterization_rgbt(**inputs)[:5]

    def gradients(images: tuple[torch.Tensor, ...], *names: str) -> list[torch.Tensor]:
        loss = sum(image.square().sum() for image in images)
        found = torch.autograd.grad(loss, [inputs[name] for name in names], retain_graph=True)
        torch.full((1_000_000,), torch.nan, device=device)  # where memory was given back
        return list(found)

    everything = gradients(images, "means", "viewmats")
    first = gradients(images[:1], "means")
    for one, other in zip(everything, gradients(images, "means", "viewmats"), strict=True):
        assert relative_error(other, one) < 1e-12
    fresh = rasterization_rgbt(**inputs)[:5]
    assert relative_error(gradients(fresh[:1], "means")[0], first[0]) < 1e-12
    assert relative_error(first[0], everything[0]) > 1e-3


def test_threads_render_at_once(device: torch.device) -> None:
    """Launches of two threads, forward and backward, do not mix their arguments."""
    scenes = [leaves(random_scene(n=30 + 20 * k, seed=k), device, torch.float64) for k in range(2)]

    def step(inputs: dict) -> torch.Tensor:
        image, _, _ = rasterization(**inputs)
        return torch.autograd.grad(image.square().sum(), inputs["means"])[0]

    expected = [step(inputs) for inputs in scenes]
    with ThreadPoolExecutor(2) as pool:
        for found in pool.map(lambda k: (k % 2, step(scenes[k % 2])), range(40)):
            assert relative_error(found[1], expected[found[0]]) < 1e-12


def test_threads_differentiate_one_scene(device: torch.device) -> None:
    """Backward passes of one graph in several threads have the gradients that each would have alone."""
    inputs = leaves(random_scene(n=500, width=80, height=60, sh_degree=3), device, torch.float64)
    loss = rasterization(**inputs)[0].square().sum()

    def gradients(_: int = 0) -> tuple[torch.Tensor, ...]:
        wanted = [inputs[name] for name in ("means", "scales", "colors", "viewmats")]
        return torch.autograd.grad(loss, wanted, retain_graph=True)

    expected = gradients()
    with ThreadPoolExecutor(2) as pool:
        for found in pool.map(gradients, range(12)):
            for one, other in zip(found, expected, strict=True):
                assert relative_error(one, other) < 1e-12


def test_opacities_retain_their_gradients(device: torch.device) -> None:
    """Those in info are per image: over the cameras their gradients sum to the inputs'."""
    inputs = leaves(random_rgbt_scene(cameras=2), device, torch.float64)
    result = rasterization_rgbt(**inputs)
    names = ("opacities", "thermal_opacities")
    for name in names:
        result.info[name].retain_grad()
    sum(image.square().sum() for image in result[:5]).backward()
    for name in names:
        assert result.info[name].grad.shape == (2, 60)
        assert inputs[name].grad.norm() > 0
        assert relative_error(result.info[name].grad.sum(0), inputs[name].grad) < 1e-12


def test_renders_may_be_changed_in_place(device: torch.device) -> None:
    """The adjoint reads no rendered colour, so that torch lets users change them. It reads the alphas."""
    plain, changed = (leaves(random_scene(backgrounds=False), device, torch.float64) for _ in range(2))
    rasterization(**plain)[0].clamp(max=0.3).sum().backward()
    rasterization(**changed)[0].clamp_(max=0.3).sum().backward()
    assert relative_error(changed["means"].grad, plain["means"].grad) < 1e-12
    image, alphas, _ = rasterization(**changed)
    alphas.clamp_(max=0.3)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_no_image_is_kept_but_what_the_caller_has(device: torch.device) -> None:
    """Beside the alphas a float32 pass keeps one number of 32 bits for each pixel and opacity."""
    scene = leaves(random_rgbt_scene(backgrounds=False), device, torch.float32)
    kept: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        kept.append(tensor)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = rasterization_rgbt(**scene)
    pixels = result.render_alphas.numel()
    images = [one for one in kept if one.numel() == pixels]
    shown = {one.data_ptr() for one in (result.render_alphas, result.render_thermal_alphas)}
    others = [one for one in images if one.data_ptr() not in shown]
    assert shown <= {one.data_ptr() for one in images}
    assert [one.dtype for one in others] == [torch.int32, torch.int32]
