"""Gradients to cameras, which all Gaussians of an image add to: sums over warps, blocks, scenes and cameras."""

from typing import Any

import pytest
import torch
from torch import Tensor

import reference_lens_rasterizer
import reference_rasterizer
from gaussian_scenes import Scene, assert_matches_reference, random_scene, relative_error
from thermosplat import RollingShutterType, rasterization

LENSES = ["plain", "radial", "rolling"]
CAMERAS = ("viewmats", "Ks", "radial_coeffs", "viewmats_rs")


def seen_through(lens: str, **arguments: Any) -> Scene:
    """A scene with colours that depend on where cameras are, in the double precision that float32 holds."""
    scene = random_scene(sh_degree=1, backgrounds=False, **arguments)
    lead = scene["Ks"].shape[:-2]
    if lens != "plain":
        scene["radial_coeffs"] = torch.tensor([-0.1, 0.02, 0.0, 0.0]).double().expand(*lead, 4).clone()
    if lens == "rolling":
        u, _, vh = torch.linalg.svd(scene["viewmats"][..., :3, :3])
        scene["viewmats"][..., :3, :3] = u @ vh
        twist = torch.tensor([0.02, -0.05, 0.03, 0.05, -0.02, 0.01]).double()
        scene["viewmats_rs"] = turned(twist.expand(*lead, 6), scene["viewmats"])
        scene["rolling_shutter"] = RollingShutterType.ROLLING_TOP_TO_BOTTOM
    return scene


def one_by_one(lens: str) -> Any:
    """The reference, which has one scene, for a batch of them."""
    renderer = reference_rasterizer if lens == "plain" else reference_lens_rasterizer

    def render(**scene: Any) -> Any:
        parts = []
        for i in range(len(scene["means"])):
            one = {name: x[i] if isinstance(x, Tensor) else x for name, x in scene.items()}
            parts.append(renderer.rasterization(**one))
        images, alphas = (torch.stack([part[k] for part in parts]) for k in (0, 1))
        return images, alphas, {"uncertain": torch.stack([part[2]["uncertain"] for part in parts])}

    return render


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("n", [37, pytest.param(64, marks=pytest.mark.slow)])
def test_scenes_and_cameras_have_gradients_of_their_own(device: torch.device, lens: str, n: int) -> None:
    """Two scenes of three cameras each; the last warp of a scene has lanes without a Gaussian, or has not."""
    scene = seen_through(lens, n=n, batch=(2,), cameras=3, width=15, height=12)
    tolerances = {"image_tolerance": 1e-11, "gradient_tolerance": 1e-9}
    scene_of_twists, render, reference = as_twists(scene, lens)
    assert_matches_reference(render, scene_of_twists, device, torch.float64, reference=reference, **tolerances)


def as_twists(scene: Scene, lens: str) -> tuple[Scene, Any, Any]:
    """Poses of a rolling shutter turn and move with six numbers each: gradients mean something along these alone."""
    reference = one_by_one(lens)
    if lens != "rolling":
        return scene, rasterization, reference
    poses = {name: scene.pop(name) for name in ("viewmats", "viewmats_rs")}
    scene |= {f"twist_{name}": torch.zeros(*x.shape[:-2], 6, dtype=torch.float64) for name, x in poses.items()}

    def from_twists(render: Any) -> Any:
        def call(**given: Any) -> Any:
            moved = {name: turned(given.pop(f"twist_{name}"), base) for name, base in poses.items()}
            return render(**given, **moved)

        return call

    return scene, from_twists(rasterization), from_twists(reference)


def turned(twists: Tensor, base: Tensor) -> Tensor:
    """View matrices after a small turn and move."""
    x, y, z, *t = twists.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, t[0], z, zero, -x, t[1], -y, x, zero, t[2], zero, zero, zero, zero]
    return torch.linalg.matrix_exp(torch.stack(rows, -1).reshape(*x.shape, 4, 4)) @ base.to(twists)


def gradients_of_cameras(scene: Scene, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """Those of a fixed random loss."""
    inputs = {name: x.to(device, dtype) if isinstance(x, Tensor) else x for name, x in scene.items()}
    asked = {name: inputs[name].requires_grad_() for name in CAMERAS if name in inputs}
    image, _, _ = rasterization(**inputs)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    found = torch.autograd.grad((image * weights.to(image)).sum(), list(asked.values()))
    return {name: x.double().cpu() for name, x in zip(asked, found, strict=True)}


@pytest.mark.parametrize("lens", LENSES)
def test_nothing_in_view_has_no_gradient(device: torch.device, lens: str) -> None:
    """All Gaussians are behind the camera, or there are none."""
    scene = seen_through(lens, n=40, cameras=2)
    scene["means"] = scene["means"] - torch.tensor([0.0, 0.0, 60.0])
    empty = seen_through(lens, n=0, cameras=2)
    for one in (scene, empty):
        found = gradients_of_cameras(one, device, torch.float32)
        assert all((x == 0).all() for x in found.values()), found


@pytest.mark.parametrize("lens", LENSES)
def test_gradients_are_the_same_on_every_run(device: torch.device, lens: str) -> None:
    """To the bit, with blending that is."""
    scene = seen_through(lens, n=300, cameras=2) | {"deterministic": True}
    first, second = (gradients_of_cameras(scene, device, torch.float32) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert all(x.norm() > 0 for x in first.values())


@pytest.mark.cuda
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("scenes", [1, 2])
def test_gaussians_out_of_view_among_a_million(lens: str, scenes: int) -> None:
    """Warps that each look at several rows of Gaussians, the last of which end early, sum what a few Gaussians add."""
    device, count = torch.device("cuda"), 2**20 + 77
    few = seen_through(lens, n=300, batch=(scenes,))
    many = dict(few)
    places = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:300].sort().values
    places[-1] = count - 1
    for name in ("means", "quats", "scales", "opacities", "colors"):
        x = few[name]
        filled = x[:, :1].expand(scenes, count, *x.shape[2:]).clone()
        if name == "means":
            filled[..., 2] = -60.0
        filled[:, places] = x
        many[name] = filled
    expected, found = (gradients_of_cameras(scene, device, torch.float32) for scene in (few, many))
    for name, truth in expected.items():
        assert truth.norm() > 0
        assert relative_error(found[name], truth) < 1e-5, name
