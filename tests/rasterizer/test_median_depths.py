"""Median depths against the weights of a dense float64 reference."""

import inspect
import sys
from itertools import product

import pytest
import torch
from torch import Tensor

import reference_rasterizer
from gaussian_scenes import Scene, leaves, random_scene
from hard_scenes import FINITE, LARGE, NON_FINITE, ON_THRESHOLDS, hard_scene
from thermosplat.rasterizer import median_depths, project, rasterization
from thermosplat.rasterizer.median_depths import covered_depths

pytestmark = pytest.mark.rotating

OF_REFERENCE = set(inspect.signature(reference_rasterizer.rasterization).parameters) - {"render_mode", "backgrounds"}
TAKEN = OF_REFERENCE & set(inspect.signature(project).parameters)
SMALL = [name for name in FINITE if name not in LARGE]
DTYPES = [torch.float32, torch.float64]


def shaped(scene: Scene) -> Scene:
    """What of a scene says where Gaussians are and how they are seen."""
    return {name: value for name, value in scene.items() if name in TAKEN}


def found_in(scene: Scene, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Median depths, in float64 on the CPU."""
    found = median_depths(project(**leaves(shaped(scene), device, dtype)))
    assert found.dtype == dtype
    return found.double().cpu()


@torch.no_grad()
def true_weights(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Weights front to back [..., C, H, W, N], depths in the same order, and which pixels are certain."""
    given = shaped(scene)
    n = given["opacities"].shape[-1]
    each = torch.eye(n, dtype=torch.float64).expand(*given["opacities"].shape[:-1], n, n)
    weights, _, info = reference_rasterizer.rasterization(**given, colors=each)
    depths, order = info["depths"].detach().sort(dim=-1, stable=True)
    order = order[..., None, None, :].expand(*weights.shape)
    return weights.gather(-1, order), depths, ~info["uncertain"]


def assert_medians(
    scene: Scene, device: torch.device, dtype: torch.dtype, *, whatever_is_on_thresholds: bool = False
) -> None:
    """Each is the depth of a Gaussian before which at most half of the weight lies, and at most half behind."""
    weights, depths, certain = true_weights(scene)
    certain |= whatever_is_on_thresholds
    found = found_in(scene, device, dtype)
    single = dtype == torch.float32
    rounding, nearness = (1e-4, 1e-5) if single else (1e-10, 1e-12)
    total = weights.sum(-1, keepdim=True)
    through = weights.cumsum(-1)
    half = total / 2
    is_median = (through >= half - rounding * total) & (through - weights <= half + rounding * total) & (weights > 0)
    depths = depths[..., None, None, :]
    near = (found[..., None] - depths).abs() <= nearness * depths.abs().clamp(min=1.0)
    right = torch.where(total[..., 0] > 0, (is_median & near).any(-1), found == 0)
    assert certain.float().mean() > 0.3
    assert right[certain].all()


@pytest.mark.parametrize(("name", "dtype"), list(product(SMALL, DTYPES)))
def test_half_of_the_weight_lies_before_it(device: torch.device, name: str, dtype: torch.dtype) -> None:
    """Over all scenes that break rasterizers."""
    assert_medians(hard_scene(name), device, dtype, whatever_is_on_thresholds=name in ON_THRESHOLDS)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "options",
    [{"batch": (2,), "cameras": 3}, {"camera_model": "ortho"}, {"with_covars": True}, {"width": 70, "height": 37}],
    ids=str,
)
def test_whichever_the_cameras(device: torch.device, options: dict[str, object], dtype: torch.dtype) -> None:
    """Several scenes and cameras, orthographic ones, covariances, and images of more than one tile."""
    assert_medians(random_scene(**options), device, dtype)  # type: ignore[arg-type]


def test_what_lies_far_behind_does_not_move_it(device: torch.device) -> None:
    """A wall of which 2% shines through: the expected depth is drawn to the other one, and the median is not."""
    depths = torch.tensor([4.0, 400.0])
    scene = {
        "means": torch.stack([torch.zeros(2), torch.zeros(2), depths], -1),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        "scales": torch.stack([depths, depths, torch.full((2,), 1e-3)], -1),
        "opacities": torch.tensor([0.98, 0.98]),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]),
    }
    given = {name: value.to(device) for name, value in scene.items()}
    found = median_depths(project(**given, width=16, height=16))
    assert (found == 4.0).all()
    expected, _, _ = rasterization(**given, colors=given["opacities"][:, None], width=16, height=16, render_mode="ED")
    assert (expected[0, 8, 8] > 10.0).all()


@pytest.mark.parametrize("name", NON_FINITE)
def test_gaussians_that_are_not_finite_are_not_there(device: torch.device, name: str) -> None:
    """Finite depths, wherever something is drawn."""
    found = found_in(hard_scene(name), device, torch.float32)
    assert found.isfinite().all()
    assert (found > 0).any()


def test_no_gaussian_no_depth(device: torch.device) -> None:
    """Zero everywhere; and no image where there is no camera."""
    scene = random_scene(n=5)
    scene["opacities"] = torch.zeros_like(scene["opacities"])
    assert not found_in(scene, device, torch.float32).any()


def test_no_gradient(device: torch.device) -> None:
    """It is a number of a Gaussian, and which one it is cannot be differentiated."""
    given = leaves(shaped(random_scene()), device, torch.float32)
    assert not median_depths(project(**given)).requires_grad


@pytest.mark.parametrize("name", SMALL)
def test_a_pixel_is_covered_where_half_of_its_light_is_held(device: torch.device, name: str) -> None:
    """The accumulated opacity that is blended says the same."""
    given = leaves(shaped(hard_scene(name)), device, torch.float64)
    depths, covered = covered_depths(project(**given))
    scene = {**given, "colors": given["opacities"][..., None]}
    alphas = rasterization(**scene)[1][..., 0].detach()
    unsure = (alphas - 0.5).abs() < 1e-6
    assert ((alphas >= 0.5) | unsure)[covered].all()
    assert ((alphas < 0.5) | unsure)[~covered].all()
    assert (depths[covered] != 0).all()


@pytest.mark.parametrize("name", SMALL)
def test_tiles_and_blocks_change_speed_alone(device: torch.device, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Depths and what is covered are the same to the bit, whatever the size of tiles and of a thread's pixels."""
    given = leaves(shaped(hard_scene(name)), device, torch.float32)
    (depths, covered), other = covered_depths(project(**given)), covered_depths(project(**given, tile_size=8))
    assert torch.equal(depths, other[0])
    assert torch.equal(covered, other[1])
    monkeypatch.setattr(sys.modules["thermosplat.rasterizer.median_depths"], "median_block", lambda device: 1)
    alone = covered_depths(project(**given))
    assert torch.equal(depths, alone[0])
    assert torch.equal(covered, alone[1])
