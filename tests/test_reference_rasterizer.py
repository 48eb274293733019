"""The dense reference itself: equal to gsplat's own torch reference, differentiable, and sound on bad Gaussians."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

import reference_rasterizer
from gaussian_scenes import gradients, leaves, random_rgbt_scene, random_scene, relative_error, upstream_gradients

RENDER_MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]


def assert_equals_gsplat(gsplat_reference: Callable[..., Any], scene: dict[str, Any]) -> None:
    """Same image and gradients, to float64 rounding."""
    scene = leaves(scene, "cpu", torch.float64)
    camera = {"camera_model": scene.pop("camera_model")}
    theirs = gsplat_reference(**scene)[:2]
    *ours, info = reference_rasterizer.rasterization(**scene, **camera)
    upstream = upstream_gradients(ours, ~info["uncertain"])
    for image, truth in zip(ours, theirs, strict=True):
        assert image.shape == truth.shape
        assert (image - truth).detach().abs()[~info["uncertain"]].max() < 1e-11
    truth = gradients(theirs, upstream, scene)
    for name, gradient in gradients(ours, upstream, scene).items():
        # Its reference differentiates the skew too, which its kernels (and this project) do not read.
        if name != "Ks":
            # Its transmittance is 1 - alpha, which cancels down to 1e-4: hence not tighter.
            assert relative_error(gradient, truth[name]) < 1e-9, name


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", RENDER_MODES)
def test_equals_gsplat_reference(gsplat_reference: Callable[..., Any], render_mode: str, rasterize_mode: str) -> None:
    """Every render mode, both rasterize modes, two cameras."""
    scene = random_scene(cameras=2, render_mode=render_mode, rasterize_mode=rasterize_mode)
    assert_equals_gsplat(gsplat_reference, scene)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_equals_gsplat_reference_with_spherical_harmonics(gsplat_reference: Callable[..., Any], sh_degree: int) -> None:
    """SH colours of each degree, shared by the cameras."""
    assert_equals_gsplat(gsplat_reference, random_scene(cameras=2, sh_degree=sh_degree))


def test_equals_gsplat_reference_with_fewer_active_bases(gsplat_reference: Callable[..., Any]) -> None:
    """sh_degree below what the coefficients hold: the others have no influence."""
    assert_equals_gsplat(gsplat_reference, random_scene(sh_degree=3) | {"sh_degree": 1})


@pytest.mark.parametrize("sh_degree", [None, 2])
def test_equals_gsplat_reference_with_batch_and_camera_colors(
    gsplat_reference: Callable[..., Any], sh_degree: int | None
) -> None:
    """Two leading batch dimensions and colours of each camera's own."""
    scene = random_scene(batch=(2, 1), cameras=2, n=25, sh_degree=sh_degree, per_camera_colors=True)
    assert_equals_gsplat(gsplat_reference, scene)


def test_equals_gsplat_reference_in_crowded_pixels(gsplat_reference: Callable[..., Any]) -> None:
    """Enough opaque Gaussians that most pixels stop at the transmittance threshold and many reach the alpha clamp."""
    scene = random_scene(n=400, seed=3)
    scene["opacities"] = scene["opacities"].sqrt().sqrt()
    scene["scales"] = scene["scales"] * 2
    assert_equals_gsplat(gsplat_reference, scene)


def test_orthographic_camera_is_the_limit_of_a_far_pinhole_camera() -> None:
    """A pinhole camera at distance d with focal length d*f tends to the orthographic camera of scale f."""
    ortho = random_scene(camera_model="ortho", backgrounds=False)
    distance = 1e7
    pinhole = ortho | {"camera_model": "pinhole", "Ks": ortho["Ks"].clone(), "viewmats": ortho["viewmats"].clone()}
    pinhole["viewmats"][:, 2, 3] += distance
    pinhole["Ks"][:, 0, 0] *= distance
    pinhole["Ks"][:, 1, 1] *= distance
    images = [reference_rasterizer.rasterization(**scene)[0] for scene in (ortho, pinhole)]
    assert (images[0] - images[1]).abs().max() < 1e-5


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_gradcheck(rasterize_mode: str, camera_model: str) -> None:
    """Autograd through the reference equals finite differences for every input."""
    scene = random_scene(n=4, width=5, height=4, sh_degree=1, camera_model=camera_model, seed=5)
    scene = leaves(scene | {"rasterize_mode": rasterize_mode}, "cpu", torch.float64)
    names = [name for name, value in scene.items() if isinstance(value, torch.Tensor)]
    assert not reference_rasterizer.rasterization(**scene)[2]["uncertain"].any()

    def render(*inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return reference_rasterizer.rasterization(**{**scene, **dict(zip(names, inputs, strict=True))})[:2]

    assert torch.autograd.gradcheck(render, [scene[name] for name in names])


def test_covariances_equal_quats_and_scales() -> None:
    """The covars of some quats and scales render the same image."""
    scene = random_scene()
    _, covars, *_ = reference_rasterizer.flat_scene(
        *(scene[name] for name in ("means", "quats", "scales")), None, scene["viewmats"], scene["Ks"]
    )
    image = reference_rasterizer.rasterization(**scene)[0]
    same = reference_rasterizer.rasterization(**scene | {"covars": covars[0], "quats": None, "scales": None})[0]
    assert (image - same).abs().max() < 1e-14


def test_chunks_of_pixels_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Splitting the image to bound memory gives the same image, gradients and absgrad."""
    results = []
    for pixels_per_chunk in (10**9, 600):
        monkeypatch.setattr(reference_rasterizer, "PIXELS_PER_CHUNK", pixels_per_chunk)
        scene = leaves(random_scene(), "cpu", torch.float64)
        image, alphas, info = reference_rasterizer.rasterization(**scene, absgrad=True)
        found = gradients([image, alphas], upstream_gradients([image, alphas], ~info["uncertain"]), scene)
        results.append((image.detach(), info["means2d"].absgrad, *found.values()))
    for one, many in zip(*results, strict=True):
        assert relative_error(many, one) < 1e-12


def test_rgbt_equals_two_calls() -> None:
    """One call for both opacities renders what two calls render, gradients included."""
    scene = leaves(random_rgbt_scene(sh_degree=1, cameras=2), "cpu", torch.float64)
    both = reference_rasterizer.rasterization_rgbt(**scene)
    upstream = upstream_gradients(both[:5], ~both.info["uncertain"])
    own = {"features", "thermal_opacities", "colors", "sh_degree", "opacities", "backgrounds"}
    geometry = {key: value for key, value in scene.items() if key not in own}

    def call(opacities: torch.Tensor, colors: torch.Tensor, **rest: Any) -> tuple[torch.Tensor, torch.Tensor]:
        return reference_rasterizer.rasterization(opacities=opacities, colors=colors, **geometry, **rest)[:2]

    colors, alphas = call(
        scene["opacities"], scene["colors"], sh_degree=scene["sh_degree"], backgrounds=scene["backgrounds"]
    )
    features, _ = call(scene["opacities"], scene["features"])
    thermal, thermal_alphas = call(scene["thermal_opacities"], scene["features"])
    separate = [colors, features, thermal, alphas, thermal_alphas]
    for one, other in zip(both[:5], separate, strict=True):
        assert (one - other).detach().abs().max() < 1e-13
    truth = gradients(separate, upstream, scene)
    for name, gradient in gradients(both[:5], upstream, scene).items():
        assert relative_error(gradient, truth[name]) < 1e-11, name


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_non_finite_gaussians_are_invisible(name: str, value: float) -> None:
    """The image and gradients are those of the scene without them; their own gradient is zero."""
    scene = leaves(random_scene(n=12, cameras=2), "cpu", torch.float64)
    with torch.no_grad():
        scene[name].view(12, -1)[3, -1] = value
    keep = torch.arange(12) != 3
    per_gaussian = ("means", "quats", "scales", "opacities", "colors")
    without = {key: v[keep].detach().requires_grad_() if key in per_gaussian else v for key, v in scene.items()}
    found = []
    for case in (scene, without):
        image, alphas, info = reference_rasterizer.rasterization(**case)
        found.append(gradients([image, alphas], upstream_gradients([image, alphas], ~info["uncertain"]), case))
    for key, gradient in found[0].items():
        assert relative_error(gradient[keep] if key in per_gaussian else gradient, found[1][key]) < 1e-12, key
        assert key not in per_gaussian or (gradient[3] == 0).all(), key


def test_uncertain_marks_pixels_on_a_threshold() -> None:
    """A pixel on a documented threshold is marked, its neighbours are not."""
    scene = random_scene(n=1, width=9, height=7, backgrounds=False)
    scene["viewmats"] = torch.eye(4, dtype=torch.float64)[None]
    scene["Ks"] = torch.tensor([[[9.0, 0, 4.5], [0, 9.0, 3.5], [0, 0, 1]]], dtype=torch.float64)
    scene["means"][0] = torch.tensor([0.0, 0.0, 3.0])  # on the centre of pixel (4, 3)
    scene["scales"][0] = 0.25
    centre = torch.zeros(7, 9, dtype=torch.bool)
    centre[3, 4] = True

    def uncertain(**changes: Any) -> torch.Tensor:
        return reference_rasterizer.rasterization(**scene | changes)[2]["uncertain"][0]

    for opacity, marked in ((0.999, True), (0.9, False), (1.0 / 255.0 * (1 + 1e-5), True), (0.02, False)):
        scene["opacities"][0] = opacity
        expected = centre if marked else torch.zeros_like(centre)
        assert torch.equal(uncertain(), expected), opacity
    scene["opacities"][0] = 0.9
    # Four layers of 0.9 leave a transmittance of 1e-4 in the centre, the threshold itself.
    layers = {name: scene[name].repeat(4, *[1] * (scene[name].dim() - 1)) for name in ("means", "quats", "scales")}
    stacked = scene | layers | {"opacities": scene["opacities"].repeat(4), "colors": scene["colors"].repeat(4, 1)}
    assert torch.equal(reference_rasterizer.rasterization(**stacked)[2]["uncertain"][0], centre)
    # Two depths that float32 can hardly tell apart: wherever both are drawn.
    stacked["means"] = stacked["means"] + torch.tensor([0, 0, 1e-6]) * torch.arange(4)[:, None]
    assert reference_rasterizer.rasterization(**stacked)[2]["uncertain"][0].sum() > 5
