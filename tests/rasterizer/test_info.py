"""The info dictionary: what is computed when it is read, and gsplat's sort keys."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch

import reference_rasterizer
from gaussian_scenes import leaves, random_rgbt_scene, random_scene, relative_error
from thermosplat import rasterization, rasterization_rgbt
from thermosplat.rasterizer.info import RasterizationInfo, clear_unseen, isect_ids, radii_of


class Given:
    """Entries, each with what makes it."""

    are_of_ranks = False

    def __init__(self, makers: dict[str, Callable[[], Any]]) -> None:
        self.keys, self._makers = list(makers), makers

    def made(self, key: str) -> Any:
        """The value of one of the keys."""
        return self._makers[key]()


def info_of(makers: dict[str, Callable[[], Any]]) -> RasterizationInfo:
    """The dictionary of such entries."""
    return RasterizationInfo(Given(makers))


@pytest.mark.parametrize(
    "read",
    [
        lambda info: info["isect_ids"],
        lambda info: info.get("isect_ids"),
        lambda info: info.setdefault("isect_ids", None),
        lambda info: dict(info)["isect_ids"],
        lambda info: {**info}["isect_ids"],
        lambda info: dict(info.items())["isect_ids"],
        lambda info: list(info.values())[list(info).index("isect_ids")],
    ],
    ids=["item", "get", "setdefault", "dict", "unpacking", "items", "values"],
)
def test_isect_ids_are_computed_once_and_only_when_read(read: Callable[[RasterizationInfo], Any]) -> None:
    """However they are read; other keys do not cause the computation."""
    calls = []

    def compute() -> torch.Tensor:
        calls.append(1)
        return torch.tensor([5, 7])

    info = info_of({"width": lambda: 23, "isect_ids": compute})
    assert (info["width"], info.get("width"), info.get("height", 18)) == (23, 23, 18)
    assert set(info) == {"width", "isect_ids"}
    assert not calls
    assert read(info).tolist() == [5, 7]
    assert read(info) is info["isect_ids"]
    assert len(calls) == 1


def test_missing_keys() -> None:
    """As in any dict."""
    info = info_of({"isect_ids": lambda: torch.empty(0)})
    assert info.setdefault("means3d", 3) == info.pop("means3d") == 3
    assert info.pop("means3d", None) is None
    with pytest.raises(KeyError, match="means3d"):
        info["means3d"]
    assert info.get("means3d") is None


def test_what_is_taken_out_is_computed() -> None:
    """pop gives the value, not the place that was kept for it."""
    info = info_of({"isect_ids": lambda: torch.tensor([5, 7])})
    assert info.pop("isect_ids").tolist() == [5, 7]
    assert "isect_ids" not in info


def test_a_computation_that_failed_is_tried_again() -> None:
    """A failure passes through and leaves the key to be computed, not without a value."""
    attempts = []

    def compute() -> int:
        attempts.append(1)
        if len(attempts) < 3:
            raise RuntimeError("out of memory")
        return 5

    info = info_of({"isect_ids": compute})
    for read in (lambda: info["isect_ids"], lambda: dict(info)):
        with pytest.raises(RuntimeError, match="out of memory"):
            read()
    assert dict(info) == {"isect_ids": 5}


@pytest.mark.parametrize(
    "put",
    [
        lambda info: info.__setitem__("conics", 7),
        lambda info: info.update({"conics": 7}),
        lambda info: info.update(conics=7),
        lambda info: info.__ior__({"conics": 7}),
    ],
    ids=["item", "update", "keyword", "ior"],
)
def test_what_is_put_in_place_of_a_computation_stays(put: Callable[[RasterizationInfo], Any]) -> None:
    """What a user stores is what is read, and nothing is computed for it."""
    info = info_of({"width": lambda: 23, "conics": lambda: pytest.fail("computed")})
    put(info)
    assert info["conics"] == info.get("conics") == dict(info)["conics"] == 7


def test_what_is_removed_is_not_computed_again() -> None:
    """A key that was deleted is missing, however it was to get its value."""
    info = info_of({"width": lambda: 23, "conics": lambda: 7, "isect_ids": lambda: 5})
    del info["conics"]
    with pytest.raises(KeyError, match="conics"):
        info["conics"]
    info.clear()
    with pytest.raises(KeyError, match="isect_ids"):
        info["isect_ids"]
    with pytest.raises(KeyError, match="empty"):
        info.popitem()


@pytest.mark.parametrize(
    "copied",
    [
        lambda info: info.copy(),
        lambda info: info | {},
        lambda info: {} | info,
        lambda info: dict([info.popitem()]),
        copy.copy,
        copy.deepcopy,
        lambda info: pickle.loads(pickle.dumps(info)),
    ],
    ids=["copy", "or", "ror", "popitem", "copy.copy", "deepcopy", "pickle"],
)
def test_copies_hold_what_is_computed(copied: Callable[[RasterizationInfo], dict[str, Any]]) -> None:
    """And not the place that was kept for it."""
    assert copied(info_of({"conics": lambda: 7})) == {"conics": 7}


def test_isect_ids_pack_image_tile_and_depth() -> None:
    """Two images of three tiles: image above two tile bits above the 32 bits of the float32 depth."""
    depths = torch.tensor([1.0, 2.0, 3.0, 4.0])
    tile_offsets = torch.tensor([0, 1, 1, 3, 3, 4, 4], dtype=torch.int32)
    flatten_ids = torch.tensor([0, 0, 1, 3], dtype=torch.int32)
    bits = depths.view(torch.int32).tolist()
    expected = [bits[0], 2 << 32 | bits[0], 2 << 32 | bits[1], (1 << 2 | 1) << 32 | bits[3]]
    assert isect_ids(flatten_ids, tile_offsets, depths, 3).tolist() == expected
    room = torch.cat([flatten_ids, torch.tensor([2**31 - 1, -5], dtype=torch.int32)])  # never written: anything
    assert isect_ids(room, tile_offsets, depths, 3).tolist() == expected


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
@pytest.mark.parametrize("deterministic", [False, True])
def test_lists_on_cuda_are_those_of_the_cpu(tile_size: int, deterministic: bool) -> None:
    """Of Gaussians that touch from a tile to a thousand: there a whole warp counts and emits those of many tiles."""
    scene = random_scene(n=500, width=700, height=500, cameras=2)
    scene["scales"] *= torch.logspace(-2, 0.5, 500)[:, None]
    infos = [
        rasterization(
            **leaves(scene, device, torch.float64), packed=False, tile_size=tile_size, deterministic=deterministic
        )[2]
        for device in ("cpu", "cuda")
    ]
    assert infos[0]["tiles_per_gauss"].max() > 1000
    assert (infos[0]["tiles_per_gauss"] == 1).any()
    for key in ("tiles_per_gauss", "isect_offsets", "flatten_ids"):
        assert torch.equal(infos[0][key], infos[1][key].cpu()), key


def test_number_of_non_finite_gaussians(device: torch.device) -> None:
    """Each counts once, whatever is wrong with it and in however many cameras; over all scenes of a batch."""
    scene = random_scene(n=20, cameras=3, batch=(2,), per_camera_colors=True)
    assert rasterization(**leaves(scene, device, torch.float32))[2]["num_nonfinite"] == 0
    scene["means"][0, 4, 1] = float("nan")
    scene["opacities"][0, 4] = float("inf")
    scene["quats"][1, 4, 0] = float("-inf")
    scene["colors"][1, :2, 7, 2] = float("nan")
    info = rasterization(**leaves(scene, device, torch.float32))[2]
    assert info["num_nonfinite"] == dict(info)["num_nonfinite"] == 3


def test_number_of_non_finite_gaussians_in_what_is_rendered(device: torch.device) -> None:
    """Features and thermal opacities count; SH coefficients above the active degree do not."""
    scene = random_rgbt_scene(n=20, sh_degree=2) | {"sh_degree": 1}
    scene["colors"][3, 8, 0] = float("nan")
    assert rasterization_rgbt(**leaves(scene, device, torch.float32)).info["num_nonfinite"] == 0
    scene["colors"][3, 3, 0] = scene["features"][5, 7] = scene["thermal_opacities"][9] = float("nan")
    assert rasterization_rgbt(**leaves(scene, device, torch.float32)).info["num_nonfinite"] == 3


@pytest.mark.parametrize(("n", "batch"), [(0, ()), (4, (0,)), (0, (0,)), (4, (2, 0))])
def test_everything_of_nothing(n: int, batch: tuple[int, ...]) -> None:
    """Without Gaussians, or in a batch without scenes, every entry can be read and every gradient is zero."""
    inputs = leaves(random_scene(n=n, batch=batch, cameras=2, sh_degree=1), "cpu", torch.float32)
    image, _, info = rasterization(**inputs, packed=False)
    image.sum().backward()
    assert not inputs["viewmats"].grad.any()
    assert not inputs["means"].grad.any()
    shapes = {key: tuple(value.shape) for key, value in info.items() if isinstance(value, torch.Tensor)}
    assert shapes["tiles_per_gauss"] == shapes["depths"] == (*batch, 2, n)
    assert shapes["conics"] == (*batch, 2, n, 3)
    assert shapes["isect_ids"] == shapes["flatten_ids"] == (0,)


@pytest.mark.parametrize("n", [0, 3])
def test_no_gaussians_none_non_finite(n: int) -> None:
    """An empty scene has none."""
    assert rasterization(**leaves(random_scene(n=n), "cpu", torch.float32))[2]["num_nonfinite"] == 0


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_non_finite_coefficients_as_stored(degree: int) -> None:
    """Coefficients given as (sh0, shN): the active ones count."""
    scene = leaves(random_scene(n=20, sh_degree=2) | {"sh_degree": degree}, "cpu", torch.float32)
    coefficients = scene["colors"].detach().clone()
    coefficients[2, 0, 0] = coefficients[3, 3, 1] = coefficients[5, 8, 2] = float("nan")
    colors = (coefficients[:, :1].contiguous(), coefficients[:, 1:].contiguous())
    assert rasterization(**scene | {"colors": colors})[2]["num_nonfinite"] == degree + 1


def test_conics_are_differentiable() -> None:
    """A loss on them has the gradient that it has in the reference."""
    scene = random_scene(cameras=2)
    found = []
    for render in (rasterization, reference_rasterizer.rasterization):
        inputs = leaves(scene, "cpu", torch.float64)
        info = render(**inputs)[2]
        visible = (info["radii"] > 0).all(-1)
        loss = info["conics"].reshape(*visible.shape, 3)[visible].square().sum()
        found.append(torch.autograd.grad(loss, [inputs[name] for name in ("means", "quats", "scales", "viewmats")]))
    for one, other in zip(*found, strict=True):
        assert other.norm() > 0
        assert relative_error(one, other) < 1e-11


@pytest.mark.parametrize("name", ["viewmats", "Ks"])
def test_cameras_that_are_not_finite(name: str) -> None:
    """Nothing is drawn before such a camera, and the count tells: all Gaussians of the scene."""
    scene = leaves(random_scene(n=20), "cpu", torch.float32)
    broken = scene[name].detach().clone()
    broken[..., 0, 0] = torch.nan
    _, alphas, info = rasterization(**scene | {name: broken})
    assert not alphas.any()
    assert info["num_nonfinite"] == 20


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_of_unseen_gaussians_there_are_zeros(device: torch.device, dtype: torch.dtype) -> None:
    """Whatever lay in the memory before: the projection writes nothing of them, and reading does."""
    scene = leaves(random_scene(n=40, cameras=2), device, dtype)
    scene["means"] = (
        scene["means"] * torch.where(torch.arange(40, device=device) % 3 == 0, -1.0, 1.0)[:, None]
    ).detach()
    shape = scene["viewmats"].shape[:-2]
    litter = [torch.full((*shape, 40, width), torch.nan, device=device, dtype=dtype) for width in (2, 1, 2, 4)]
    del litter  # which the allocator hands out again
    info = rasterization(**scene, packed=False)[2]
    unseen = ~info["visible"]
    assert 0 < unseen.sum() < unseen.numel()
    assert info["radii"].dtype == torch.int32
    assert (info["radii"][~unseen] > 0).all()
    for key in ("means2d", "depths", "radii", "conics", "tiles_per_gauss"):
        assert (info[key][unseen] == 0).all(), key
        assert (info[key][~unseen] != 0).any(), key


def test_radii_are_what_gsplat_says() -> None:
    """Half sizes rounded up, as large as an int32 holds, and 0 where nothing is drawn."""
    extents = torch.tensor([[0.2, 3.0], [3.1, 2e9], [torch.nan, 5.0]])
    visible = torch.tensor([True, True, False])
    assert radii_of(extents, visible).tolist() == [[1, 3], [4, 1_000_000_000], [0, 0]]


def test_cleared_tensors_keep_their_graph() -> None:
    """Zeros are written behind autograd's back, since nothing has read what lay there."""
    leaf = torch.tensor([1.0, torch.nan], requires_grad=True)
    values = leaf * 2.0
    squares = (values * values)[:1]
    cleared = clear_unseen(values, torch.tensor([True, False]))
    assert cleared is values
    assert values.tolist() == [2.0, 0.0]
    squares.sum().backward()
    assert leaf.grad is not None
    assert leaf.grad[0] == 8.0
