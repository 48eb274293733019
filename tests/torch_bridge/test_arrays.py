"""The bridge between torch and Warp: memory, streams, ownership."""

import pytest
import torch
from torch.multiprocessing.reductions import StorageWeakRef

from gaussian_scenes import gradients, leaves, random_scene, relative_error, upstream_gradients
from thermosplat import rasterization
from thermosplat.torch_bridge.arrays import SCALARS, strided_view, vector_of, view
from thermosplat.torch_bridge.streams import on_torch_stream


@pytest.mark.parametrize("dtype", list(SCALARS))
def test_view_shares_memory(device: torch.device, dtype: torch.dtype) -> None:
    """A tensor's memory seen as vectors."""
    tensor = torch.arange(12, dtype=dtype, device=device).reshape(4, 3)
    array = view(tensor, vector_of(3, dtype))
    assert array.shape == (4,)
    assert array.ptr == tensor.data_ptr()
    tensor[2, 1] = -7.0
    assert array.numpy()[2, 1] == -7.0


@pytest.mark.parametrize("dtype", list(SCALARS))
def test_strided_view_is_the_same_numbers(device: torch.device, dtype: torch.dtype) -> None:
    """Whatever the strides are: slices, transposed, one column."""
    tensor = torch.arange(24, dtype=dtype, device=device).reshape(4, 3, 2)
    for part in (tensor, tensor[1:, :, 1], tensor[..., :1], tensor.permute(2, 0, 1), tensor[:0]):
        assert strided_view(part).numpy().tolist() == part.tolist()


def test_on_torch_stream_gives_the_tensors_device(device: torch.device) -> None:
    """The Warp device of torch's device, on torch's current stream."""
    with on_torch_stream(device) as warp_device:
        assert warp_device.is_cuda == (device.type == "cuda")
        if warp_device.is_cuda:
            assert warp_device.stream.cuda_stream == torch.cuda.current_stream(device).cuda_stream


def test_in_place_changes_between_forward_and_backward_are_caught(device: torch.device) -> None:
    """The adjoint reads the inputs again: torch refuses when they were changed, instead of a wrong gradient."""
    scene = leaves(random_scene(n=10), device, torch.float32)
    for name in ("means", "scales", "opacities", "colors", "viewmats"):
        inputs = {k: v * 1 if isinstance(v, torch.Tensor) else v for k, v in scene.items()}  # no leaves
        loss = rasterization(**inputs)[0].sum()
        inputs[name].mul_(1.5)
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            loss.backward()


def test_results_survive_later_renders(device: torch.device) -> None:
    """Images, info and pending gradients of one render are not overwritten by the next: no shared workspace."""
    first = leaves(random_scene(n=40), device, torch.float64)
    second = leaves(random_scene(n=90, seed=1, width=60, height=50), device, torch.float64)
    image, alphas, info = rasterization(**first)
    kept = [image.detach().clone(), info["flatten_ids"].clone(), info["radii"].clone()]
    rasterization(**second)[0].sum().backward()
    assert all(torch.equal(a, b) for a, b in zip(kept, [image, info["flatten_ids"], info["radii"]], strict=True))
    upstream = upstream_gradients([image, alphas], torch.ones(1, 18, 23))
    found = gradients([image, alphas], upstream, first)
    again = leaves(first, device, torch.float64)
    truth = gradients(rasterization(**again)[:2], upstream, again)
    assert all(relative_error(found[name], truth[name]) < 1e-12 for name in found)


def test_gradients_flow_to_what_made_the_inputs(device: torch.device) -> None:
    """Activations before and losses after the renderer are ordinary autograd."""
    scene = leaves(random_scene(n=20), device, torch.float64)
    logits = torch.logit(scene["opacities"]).detach().requires_grad_()
    log_scales = scene["scales"].log().detach().requires_grad_()
    image, _, _ = rasterization(**scene | {"opacities": logits.sigmoid(), "scales": log_scales.exp()})
    (image - 0.5).square().mean().backward()
    direct = leaves(scene, device, torch.float64)
    (rasterization(**direct)[0] - 0.5).square().mean().backward()
    sigmoid = scene["opacities"].detach()
    assert relative_error(logits.grad, direct["opacities"].grad * sigmoid * (1 - sigmoid)) < 1e-12
    assert relative_error(log_scales.grad, direct["scales"].grad * scene["scales"].detach()) < 1e-12


def test_the_backward_pass_frees_what_the_forward_pass_kept(device: torch.device) -> None:
    """An image that is kept after its backward pass keeps none of the lists it was blended from."""
    image, alphas, info = rasterization(**leaves(random_scene(n=40), device, torch.float32), packed=False)
    lists = [StorageWeakRef(info[name].untyped_storage()) for name in ("flatten_ids", "tiles_per_gauss")]
    del info
    assert not any(storage.expired() for storage in lists)
    image.sum().backward()
    assert all(storage.expired() for storage in lists)
    assert torch.isfinite(image).all()
    assert torch.isfinite(alphas).all()


def test_second_derivatives_are_refused(device: torch.device) -> None:
    """There is no adjoint of the adjoint: asking for one is an error, not a wrong number."""
    scene = leaves(random_scene(n=10), device, torch.float64)
    image = rasterization(**scene)[0]
    (first,) = torch.autograd.grad(image.square().sum(), scene["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


@pytest.mark.cuda
def test_side_streams() -> None:
    """Rendering on a stream of torch's own waits for its inputs and is waited for."""
    scene = random_scene(n=200, width=120, height=90)
    inputs = leaves(scene, "cuda", torch.float32)
    image = rasterization(**inputs)[0]
    gradient = torch.autograd.grad(image.sum(), inputs["means"])[0]
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    for _ in range(20):
        with torch.cuda.stream(stream):
            torch.cuda._sleep(2_000_000)
            delayed = inputs | {"colors": inputs["colors"] * 2 - inputs["colors"]}
            same, _, _ = rasterization(**delayed)
            difference = (same - image).detach().abs().max()
            again = torch.autograd.grad(same.sum(), inputs["means"])[0]
            difference_of_gradients = (again - gradient).norm() / gradient.norm()
        stream.synchronize()
        assert difference.item() < 1e-5
        assert difference_of_gradients.item() < 1e-4
