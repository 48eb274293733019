"""Lists that the lanes of a warp share."""

import numpy as np
import pytest
import torch
import warp as wp

from gaussian_scenes import leaves, random_scene
from thermosplat import rasterization
from warp_kernels.binning import binning_step
from warp_kernels.color import color_step
from warp_kernels.machinery.lanes import LANES_CUDA, warp_sync
from warp_kernels.machinery.warp_lists import MANY, WARPS, list_functions, threads_of_many
from warp_kernels.projection import plain_camera_step

CAPACITY = 64
LIST_OF_WARP, APPEND, ITEM = list_functions(WARPS, CAPACITY)


@wp.kernel(enable_backward=False, module="unique")
def odd_then_large_kernel(values: wp.array(dtype=int), counts: wp.array(dtype=int), listed: wp.array2d(dtype=int)):
    """Each warp lists its odd values, then those above 90."""
    thread = wp.tid()
    warp, lane = thread // wp.static(LANES_CUDA), thread % wp.static(LANES_CUDA)
    own = LIST_OF_WARP(warp % wp.static(WARPS))
    count = APPEND(own, 0, lane, values[thread] % 2 == 1, values[thread])
    count = APPEND(own, count, lane, values[thread] > 90, values[thread])
    warp_sync()
    counts[warp] = count
    for k in range(lane, count, wp.static(LANES_CUDA)):
        listed[warp, k] = ITEM(own, k)


@pytest.mark.cuda
def test_a_list_has_its_warps_values_in_their_order() -> None:
    """Of ten warps in two blocks of threads; what is appended later comes behind."""
    values = np.random.default_rng(0).integers(0, 100, (10, LANES_CUDA))
    counts = wp.zeros(10, dtype=int, device="cuda")
    listed = wp.zeros((10, CAPACITY), dtype=int, device="cuda")
    inputs = [wp.array(values.flatten(), dtype=int, device="cuda"), counts, listed]
    wp.launch(odd_then_large_kernel, dim=values.size, inputs=inputs, device="cuda")
    for own, count, found in zip(values, counts.numpy(), listed.numpy(), strict=True):
        assert found[:count].tolist() == [*own[own % 2 == 1], *own[own > 90]]


@pytest.mark.parametrize("count", [1, MANY - 1, MANY, MANY + 1, 10 * MANY])
def test_threads_are_whole_warps_that_cover_all(count: int) -> None:
    """The fewest warps whose candidates are enough."""
    threads = threads_of_many(count)
    assert threads % LANES_CUDA == 0
    assert threads // LANES_CUDA * MANY >= count > (threads // LANES_CUDA - 1) * MANY


@pytest.mark.cuda
@pytest.mark.parametrize("options", [{}, {"rasterize_mode": "antialiased"}, {"with_covars": True}, {"batch": (2,)}])
@pytest.mark.parametrize("n", [5, 129, 700])
def test_kernels_that_look_at_many_do_what_the_others_do(
    options: dict, n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images and all gradients, where half of the Gaussians lie behind the camera and get zeros."""
    scene = random_scene(n=n, sh_degree=3, width=70, height=50, **options)
    scene["means"][..., ::2, 2] -= 20.0

    def gradients() -> dict[str, torch.Tensor]:
        inputs = leaves(scene, torch.device("cuda"), torch.float32)
        image, _, info = rasterization(**inputs, packed=False)
        assert (info["radii"][..., ::2, :] == 0).all()
        image.square().sum().backward()
        found = {name: value.grad for name, value in inputs.items() if isinstance(value, torch.Tensor)}
        return {"image": image.detach(), **{name: value for name, value in found.items() if value is not None}}

    expected = gradients()
    for module, limit in ((binning_step, "COMPACTED"), (color_step, "LISTED"), (plain_camera_step, "LISTED")):
        monkeypatch.setattr(module, limit, 0)
    found = gradients()
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-6 * float(value.abs().max()))
