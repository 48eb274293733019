"""Launches on images are made again on other images."""

from collections.abc import Callable

import torch
import warp as wp

from thermosplat.rasterizer.replay.image_launches import LaunchedByReplays, LaunchedNow, Places
from thermosplat.torch_bridge.arrays import vector_of, view
from warp_kernels.blending.blended_arrays import BlendedArrays
from warp_kernels.machinery.array_views import ArrayView


def image(tensor: torch.Tensor) -> ArrayView:
    """An array on a tensor [H, W, 3]."""
    return view(tensor, vector_of(3, torch.float32), *tensor.shape[:2])


def blended_to(*renders: torch.Tensor) -> BlendedArrays:
    """What a blending writes to one or two images."""
    transmittance, ends, alphas = (view(torch.zeros(2, 3), wp.float32, 2, 3) for _ in range(3))
    return BlendedArrays(image(renders[0]), transmittance, ends, alphas, *[image(render) for render in renders[1:]])


def test_a_replay_says_where_images_lie() -> None:
    """A place that is not given is the fixed memory, also after another one was."""
    fixed, other = (torch.zeros(2, 2, 3, 3).unbind() for _ in range(2))
    left: list[Callable[[], None]] = []
    places, seen = Places(), []
    launcher = LaunchedByReplays(torch.device("cpu"), left.append, places)
    blended = blended_to(*fixed)
    alphas, home = torch.zeros(2, 3), blended.alphas.ptr
    launcher.forward(lambda: seen.append((blended.render.ptr, blended.thermal_render.ptr, blended.alphas.ptr)), blended)
    assert seen == []
    (launch,) = left
    places.images[:] = [other[0].data_ptr(), None, alphas.data_ptr(), None]
    launch()
    places.images[:] = [None, other[1].data_ptr(), None, None]
    launch()
    assert seen == [
        (other[0].data_ptr(), fixed[1].data_ptr(), alphas.data_ptr()),
        (fixed[0].data_ptr(), other[1].data_ptr(), home),
    ]
    assert launcher.blended == [blended]


def test_a_replay_says_where_gradients_lie() -> None:
    """Absent ones stay absent; the launcher knows where it read while it was recorded."""
    fixed, other = torch.zeros(2, 3, 3), torch.zeros(2, 3, 3)
    left: list[Callable[[], None]] = []
    places, seen = Places(), []
    launcher = LaunchedByReplays(torch.device("cpu"), left.append, places)
    gradient = image(fixed)
    launcher.backward(lambda: seen.append(gradient.ptr), (None, gradient, None, None, None))
    assert launcher.read == (None, fixed.data_ptr(), None, None, None)
    places.gradients[1] = other.data_ptr()
    (launch,) = left
    launch()
    assert seen == [other.data_ptr()]


def test_launches_may_be_made_at_once() -> None:
    """Where a call is only run, to see what its images are."""
    launcher, seen = LaunchedNow(), []
    blended = blended_to(torch.zeros(2, 3, 3))
    launcher.forward(lambda: seen.append("forward"), blended)
    launcher.backward(lambda: seen.append("backward"), (None,))
    assert (seen, launcher.blended) == (["forward", "backward"], [blended])
