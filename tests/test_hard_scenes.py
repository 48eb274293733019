"""The catalogue of scenes that break rasterizers: right where that is possible, finite everywhere."""

from itertools import product

import pytest
import torch

from gaussian_scenes import assert_finite, assert_matches_reference, gradients, leaves, upstream_gradients
from hard_scenes import FINITE, LARGE, NON_FINITE, ON_THRESHOLDS, hard_scene
from thermosplat import rasterization

SMALL = [name for name in FINITE if name not in LARGE]
CROWDS = [name for name in FINITE if name.startswith("5,000")]
DTYPES = [torch.float32, torch.float64]


@pytest.mark.parametrize(("name", "dtype"), list(product(SMALL, DTYPES)))
def test_finite_in_finite_out(device: torch.device, name: str, dtype: torch.dtype) -> None:
    """Image and all gradients are finite, and so they are with the other filter and without one."""
    scene = hard_scene(name)
    other = "classic" if scene.get("rasterize_mode") == "antialiased" else "antialiased"
    for changes in ({}, {"rasterize_mode": other}, {"eps2d": 0.0}, {"near_plane": 0.0}):
        assert_finite(rasterization, scene | changes, device, dtype)


@pytest.mark.parametrize("name", NON_FINITE)
def test_non_finite_gaussians_are_counted_and_get_no_gradient(device: torch.device, name: str) -> None:
    """Every fourth of 60 Gaussians: invisible, in no gradient, and in info."""
    scene = hard_scene(name)
    assert_finite(rasterization, scene, device)
    inputs = leaves(scene, device, torch.float32)
    image, alphas, info = rasterization(**inputs)
    assert info["num_nonfinite"] == 15
    assert (info["radii"][:, ::4] == 0).all()
    found = gradients([image, alphas], upstream_gradients([image, alphas], torch.ones(alphas.shape[:-1])), inputs)
    for key in ("means", "quats", "scales", "covars", "opacities", "colors"):
        if key in found:
            assert (found[key][::4] == 0).all(), key
    assert found["means"].abs().sum() > 0


@pytest.mark.parametrize("name", CROWDS)
def test_transmittance_does_not_drift(device: torch.device, name: str) -> None:
    """Over 5,000 layers the image stays within 2e-6, and gradients, whose T is recovered by division, within 1e-5."""
    for dtype in DTYPES:
        assert_matches_reference(rasterization, hard_scene(name), device, dtype)


@pytest.mark.parametrize("name", ["1e6 from the origin", "1e6 from the origin, turned, SH degree 3"])
def test_far_from_the_origin_float32_is_as_exact_as_near_it(device: torch.device, name: str) -> None:
    """World coordinates are subtracted in float64: only their own rounding, which the truth shares, is left."""
    assert_matches_reference(rasterization, hard_scene(name), device)


@pytest.mark.parametrize("name", ON_THRESHOLDS)
def test_exactly_on_thresholds(device: torch.device, name: str) -> None:
    """Where float32 computes exactly, it decides as float64 does: in every pixel, up to alpha's own rounding."""
    images = [rasterization(**leaves(hard_scene(name), device, dtype))[:2] for dtype in (torch.float32, torch.float64)]
    for single, double in zip(*images, strict=True):
        assert (single.double() - double).abs().max() < 2e-6


def test_expected_depth_of_faint_pixels(device: torch.device) -> None:
    """The depth is divided by the weights' sum, not by 1 - T, which has few digits left where alpha is 1/255."""
    scene = hard_scene("ordinary, expected depth")
    scene["opacities"] = (scene["opacities"] * 0.02 + 0.004).float().double()
    expected, alphas, _ = rasterization(**leaves(scene, device, torch.float64))
    found, _, _ = rasterization(**leaves(scene, device, torch.float32))
    drawn = (alphas > 0).squeeze(-1)
    assert drawn.any()
    assert (alphas[drawn] < 0.01).any()
    close = (found[..., -1].double() - expected[..., -1]).abs()[drawn] < 4e-6
    assert close.double().mean() > 0.99  # but for pixels in which rounding decides what is drawn
