"""info of packed=True: gsplat's rows, on the path of the gradient like the whole tensors."""

import weakref
from typing import Any

import pytest
import torch

from gaussian_scenes import leaves, random_scene, relative_error
from thermosplat import rasterization, rasterize_to_pixels
from thermosplat.rasterizer.info import SceneEntries
from thermosplat.rasterizer.packed_info import PackedEntries

ROWS = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss")


def both(device: torch.device, **arguments: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """The same call packed, which is the default, and not; half of the Gaussians are out of view."""
    scene = random_scene(n=40, cameras=2, **arguments)
    scene["means"][..., ::2, :] *= 5.0
    given = [leaves(scene, device, torch.float64) for _ in range(2)]
    return rasterization(**given[0]), rasterization(**given[1], packed=False)


@pytest.mark.parametrize("batch", [(), (2,), (2, 1)])
def test_rows_are_those_of_the_seen(device: torch.device, batch: tuple[int, ...]) -> None:
    """In the order of scenes, cameras and Gaussians, with three indices; images are the same."""
    (image, _, packed), (expected, _, whole) = both(device, batch=batch)
    assert torch.equal(image, expected)
    visible = whole["visible"]
    scenes, cameras, gaussians = visible.reshape(-1, 2, 40).nonzero().unbind(-1)
    assert 0 < len(gaussians) < visible.numel()
    for key, ids in (("batch_ids", scenes), ("camera_ids", cameras), ("gaussian_ids", gaussians)):
        assert packed[key].dtype == torch.int64
        assert torch.equal(packed[key], ids)
    for key in ROWS:
        assert torch.equal(packed[key], whole[key][visible]), key
    others = set(whole) - {*ROWS, "batch_ids", "camera_ids", "gaussian_ids", "flatten_ids"}
    assert set(packed) == set(whole)
    for key in others:
        assert torch.equal(torch.as_tensor(packed[key]), torch.as_tensor(whole[key])), key


def test_gsplats_steps_draw_packed_rows(device: torch.device) -> None:
    """flatten_ids count rows: rasterize_to_pixels of packed tensors blends the image that the call returned."""
    (image, _, packed), _ = both(device, backgrounds=False)
    colors = random_scene(n=40, cameras=2, backgrounds=False)["colors"].to(device)[packed["gaussian_ids"]]
    lists = (packed["tile_size"], packed["isect_offsets"], packed["flatten_ids"])
    size = (packed["width"], packed["height"])
    drawn, _ = rasterize_to_pixels(
        packed["means2d"], packed["conics"], colors, packed["opacities"], *size, *lists, packed=True
    )
    torch.testing.assert_close(drawn, image, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("key", ["means2d", "depths", "opacities"])
def test_rows_retain_the_images_gradient(device: torch.device, key: str) -> None:
    """.grad and .absgrad are the whole tensors' rows, with a loss on the rows themselves and a second pass, too."""
    results = []
    for image, _, info in both(device, absgrad=True, render_mode="RGB+D"):
        info[key].retain_grad()
        for _ in range(2):
            (image.square().sum() + info[key].square().sum()).backward(retain_graph=True)
        results.append(info)
    packed, whole = (one[key] for one in results)
    visible = results[1]["visible"]
    assert packed.grad.norm() > 0
    assert relative_error(packed.grad, whole.grad[visible]) < 1e-12
    if key == "means2d":
        assert relative_error(packed.absgrad, whole.absgrad[visible]) < 1e-12


def test_rows_read_without_gradients_retain_them_all_the_same(device: torch.device) -> None:
    """A strategy that looks at info under no_grad first."""
    (image, _, packed), _ = both(device)
    with torch.no_grad():
        packed["means2d"].sum()
    packed["means2d"].retain_grad()
    image.sum().backward()
    assert packed["means2d"].grad.norm() > 0


def test_rows_do_not_hold_the_graph(device: torch.device) -> None:
    """What a call made goes with its results, without a collection of cycles."""
    inputs = leaves(random_scene(n=10), device, torch.float32)
    results = rasterization(**inputs)
    results[-1]["means2d"].retain_grad()
    leaf = weakref.ref(inputs["means"])
    del results, inputs
    assert leaf() is None


class OfRanks(SceneEntries):
    """Entries as a distributed call has them."""

    are_of_ranks = True


def test_lists_of_ranks_count_what_was_received(device: torch.device) -> None:
    """As in gsplat, pairs of a distributed call are not of the rows that this rank projected."""
    (_, _, whole), (_, _, packed) = (both(device)[1] for _ in range(2))
    packed.entries = PackedEntries(OfRanks(*packed.entries))
    for key in ("flatten_ids", "tiles_per_gauss"):
        assert torch.equal(packed[key], whole[key])
    assert torch.equal(packed["radii"], whole["radii"][whole["visible"]])


@pytest.mark.parametrize("n", [0, 3])
def test_nothing_seen(device: torch.device, n: int) -> None:
    """No rows, of no Gaussians and of such behind the camera."""
    scene = random_scene(n=n)
    scene["means"] = scene["means"] - 100.0
    info = rasterization(**leaves(scene, device, torch.float32))[2]
    assert [info[key].shape[0] for key in (*ROWS, "gaussian_ids", "flatten_ids")] == [0] * 8
