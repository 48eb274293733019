"""rasterization_rgbt(): one traversal for both spectra equals the reference and two separate calls."""

from typing import Any

import pytest
import torch

import reference_rasterizer
from gaussian_scenes import (
    assert_matches_reference,
    gradients,
    leaves,
    random_rgbt_scene,
    relative_error,
    upstream_gradients,
)
from thermosplat import rasterization, rasterization_rgbt

pytestmark = pytest.mark.rotating


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_matches_reference(device: torch.device, rasterize_mode: str, camera_model: str, dtype: torch.dtype) -> None:
    """All five images and every gradient, both opacities included, two cameras, SH colours."""
    scene = random_rgbt_scene(cameras=2, sh_degree=2, rasterize_mode=rasterize_mode, camera_model=camera_model)
    assert_matches_reference(rasterization_rgbt, scene, device, dtype, rgbt=True)


@pytest.mark.parametrize("features", [1, 3, 8, 16, 29])
def test_number_of_features(device: torch.device, features: int) -> None:
    """Other latent sizes than the paper's 8."""
    scene = random_rgbt_scene(n=30, features=features)
    assert_matches_reference(rasterization_rgbt, scene, device, rgbt=True)


@pytest.mark.parametrize(("width", "height", "tile_size"), [(1, 1, 16), (17, 5, 8), (61, 47, 32), (61, 47, 16)])
def test_ragged_sizes_and_tiles(device: torch.device, width: int, height: int, tile_size: int) -> None:
    """Image sizes that are no multiple of the tile, with each tile size."""
    scene = random_rgbt_scene(n=40, width=width, height=height, tile_size=tile_size, backgrounds=False)
    assert_matches_reference(rasterization_rgbt, scene, device, rgbt=True)


def test_batch_dims_and_camera_colors(device: torch.device) -> None:
    """Leading batch dimensions and SH coefficients of each camera's own."""
    scene = random_rgbt_scene(n=25, batch=(2,), cameras=2, sh_degree=1, per_camera_colors=True)
    assert_matches_reference(rasterization_rgbt, scene, device, rgbt=True)


def test_crowded_pixels_stop_each_opacity_on_its_own(device: torch.device) -> None:
    """Where one opacity has filled a pixel the traversal goes on for the other."""
    scene = random_rgbt_scene(n=300, seed=3)
    scene["opacities"] = scene["opacities"].sqrt().sqrt().float().double()
    scene["thermal_opacities"] = (0.2 * scene["thermal_opacities"]).float().double()
    for swap in (False, True):
        case = dict(scene)
        if swap:
            case |= {"opacities": scene["thermal_opacities"], "thermal_opacities": scene["opacities"]}
        _, truth = assert_matches_reference(rasterization_rgbt, case, device, rgbt=True)
        assert (truth.render_alphas - truth.render_thermal_alphas).abs().mean() > 0.02


def two_calls(scene: dict[str, Any]) -> list[torch.Tensor]:
    """The five images from two calls of rasterization."""
    own = ("features", "thermal_opacities", "colors", "opacities", "sh_degree", "backgrounds")
    geometry = {key: value for key, value in scene.items() if key not in own}
    opacities, features = scene["opacities"], scene["features"]
    colors, alphas, _ = rasterization(
        opacities=opacities,
        colors=scene["colors"],
        sh_degree=scene["sh_degree"],
        backgrounds=scene["backgrounds"],
        **geometry,
    )
    visible, _, _ = rasterization(opacities=opacities, colors=features, **geometry)
    thermal, thermal_alphas, _ = rasterization(opacities=scene["thermal_opacities"], colors=features, **geometry)
    return [colors, visible, thermal, alphas, thermal_alphas]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_equals_two_calls(device: torch.device, rasterize_mode: str, dtype: torch.dtype) -> None:
    """Forward and every gradient equal two rasterization calls, to rounding, thresholds included."""
    scene = random_rgbt_scene(cameras=2, sh_degree=3, n=80, rasterize_mode=rasterize_mode)
    inputs = leaves(scene, device, dtype)
    both = rasterization_rgbt(**inputs)
    separate = two_calls(inputs)
    certain = ~reference_rasterizer.rasterization_rgbt(**scene).info["uncertain"]
    upstream = upstream_gradients(separate, certain)
    single = dtype == torch.float32
    for one, other in zip(both[:5], separate, strict=True):
        assert (one - other).detach().abs().max() <= (1e-6 if single else 1e-13)
    truth = gradients(separate, upstream, inputs)
    for name, gradient in gradients(both[:5], upstream, inputs).items():
        assert relative_error(gradient, truth[name]) <= (1e-5 if single else 1e-11), name
        assert truth[name].norm() > 0


def test_equal_opacities_reproduce_the_single_pass(device: torch.device) -> None:
    """Without geometric decoupling both halves are the same render."""
    inputs = leaves(random_rgbt_scene(), device, torch.float32)
    inputs["thermal_opacities"] = inputs["opacities"].detach().clone().requires_grad_()
    both = rasterization_rgbt(**inputs)
    assert torch.equal(both.render_features, both.render_thermal_features)
    assert torch.equal(both.render_alphas, both.render_thermal_alphas)


def test_an_invisible_spectrum(device: torch.device) -> None:
    """A Gaussian that is transparent in one spectrum (glass, plastic film) is drawn in the other."""
    scene = random_rgbt_scene(n=40)
    scene["opacities"][::2] = 0.0
    scene["thermal_opacities"][1::2] = 0.0
    _, truth = assert_matches_reference(rasterization_rgbt, scene, device, rgbt=True)
    assert truth.info["visible"].float().mean() > 0.5


def test_gradcheck(device: torch.device) -> None:
    """Both opacities, features, colours and geometry against central differences in float64."""
    scene = random_rgbt_scene(n=4, width=5, height=4, sh_degree=1, features=2, seed=5, rasterize_mode="antialiased")
    assert not reference_rasterizer.rasterization_rgbt(**scene).info["uncertain"].any()
    inputs = leaves(scene, device, torch.float64)
    names = [name for name, value in inputs.items() if isinstance(value, torch.Tensor)]

    def render(*tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(rasterization_rgbt(**{**inputs, **dict(zip(names, tensors, strict=True))})[:5])

    tolerance = 0.0 if device.type == "cpu" else 1e-10
    assert torch.autograd.gradcheck(render, [inputs[name] for name in names], nondet_tol=tolerance)


@pytest.mark.parametrize("features", [8, 20])  # 20: more than one traversal takes
def test_means2d_gradient_sums_both_passes(device: torch.device, features: int) -> None:
    """info["means2d"] retains the summed gradient of both spectra and absgrad the sum of absolute values."""
    scene = random_rgbt_scene(cameras=2, absgrad=True, features=features)
    results = []
    for render, dtype, where in (
        (reference_rasterizer.rasterization_rgbt, torch.float64, "cpu"),
        (rasterization_rgbt, torch.float32, device),
    ):
        result = render(**leaves(scene, where, dtype))
        means2d = result.info["means2d"]
        means2d.retain_grad()
        if dtype == torch.float64:
            upstream = upstream_gradients(result[:5], ~result.info["uncertain"])
        sum((image * up.to(image)).sum() for image, up in zip(result[:5], upstream, strict=True)).backward()
        results.append([t.reshape(2, -1, 2).double().cpu() for t in (means2d.grad, means2d.absgrad)])
    (true_grad, _), (grad, absolute) = results
    assert relative_error(grad, true_grad) < 1e-5
    # Per pixel the two passes may be summed before or after taking the absolute value: bounded by both.
    assert (absolute <= results[0][1] * (1 + 1e-5) + 1e-6).all()
    assert (absolute >= true_grad.abs() * (1 - 1e-5) - 1e-6).all()
    assert absolute.sum() > 1.05 * true_grad.abs().sum()


@pytest.mark.parametrize("n", [0, 5])
def test_nothing_to_draw(device: torch.device, n: int) -> None:
    """No Gaussian, or none in view: background, zero features, zero alphas, zero gradients."""
    scene = random_rgbt_scene(n=n, cameras=2)
    scene["means"] = scene["means"] - 100.0
    inputs = leaves(scene, device, torch.float32)
    result = rasterization_rgbt(**inputs)
    assert (result.render_colors.cpu() == scene["backgrounds"][:, None, None].float()).all()
    assert all((image == 0).all() for image in result[1:5])
    assert result.render_thermal_features.shape == (2, 18, 23, 8)
    sum(image.sum() for image in result[:5]).backward()
    for name in ("means", "opacities", "thermal_opacities", "features", "colors"):
        assert inputs[name].grad is None or (inputs[name].grad == 0).all()


def test_info_is_that_of_rasterization(device: torch.device) -> None:
    """The same keys and shapes as rasterization's info, so that strategies work on either."""
    scene = random_rgbt_scene(cameras=2)
    inputs = leaves(scene, device, torch.float32)
    info = rasterization_rgbt(**inputs).info
    del inputs["features"], inputs["thermal_opacities"]
    single = rasterization(**inputs)[2]
    assert set(single) <= set(info)
    truth = reference_rasterizer.rasterization_rgbt(**scene).info
    assert info["radii"].dtype == torch.int32
    assert torch.equal(info["radii"].cpu(), truth["radii"])
    assert info["means2d"].shape == (2, 60, 2)
    assert (info["width"], info["height"], info["n_cameras"]) == (23, 18, 2)
