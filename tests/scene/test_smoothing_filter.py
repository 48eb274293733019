"""Mip-Splatting's 3D smoothing filter against its formula in float64."""

import numpy as np
import pytest
import torch

from thermosplat.datasets.cameras import Camera
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.smoothing_filter import (
    SamplingCamera,
    filter_deviations,
    filtered,
    sampling_cameras,
    sampling_rates,
    set_filter,
    store_filtered,
)
from toy_scene import render, toy_capture, toy_config, toy_frame, toy_model

NARROW = Camera(120.0, 110.0, 50.0, 40.0, 100, 80)
WIDE = Camera(60.0, 60.0, 50.0, 40.0, 100, 80)


def moved(camera: Camera, z: float) -> SamplingCamera:
    """A camera that looks along z from (0, 0, z)."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = -z
    return SamplingCamera(viewmat, camera)


def test_the_largest_rate_of_the_cameras_that_see_a_mean() -> None:
    """Behind a camera and beyond 15% of an image's sides nothing is seen; the larger focal length counts."""
    cameras = [moved(NARROW, 0.0), moved(WIDE, 2.0)]
    means = torch.tensor(
        [
            [0.0, 0.0, 4.0],  # in both: 120 / 4, 60 / 2
            [0.0, 0.0, 2.5],  # 120 / 2.5, 60 / 0.5
            [0.0, 0.0, 1.0],  # behind the second
            [2.0, 0.0, 4.0],  # column 110 of the first, 110 of the second
            [2.2, 0.0, 4.0],  # column 116: beyond 115, in both
            [0.0, 0.0, -1.0],  # behind both
        ],
        dtype=torch.float64,
    )
    expected = torch.tensor([30.0, 120.0, 120.0, 30.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(sampling_rates(means, cameras), expected)
    deviations = np.sqrt(0.2) / np.array([30.0, 120.0, 120.0, 30.0, 30.0, 30.0])
    torch.testing.assert_close(filter_deviations(means, cameras), torch.from_numpy(deviations))
    torch.testing.assert_close(filter_deviations(means.float(), cameras), torch.from_numpy(deviations).float())
    assert not filter_deviations(means[-1:], cameras).any()
    assert len(filter_deviations(means[:0], cameras)) == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_scales_and_opacities_of_the_formula(dtype: torch.dtype) -> None:
    """The covariance gains s / ν² along every axis; the opacity falls by the root of the determinants' ratio."""
    generator = torch.Generator().manual_seed(0)
    scales = torch.exp(torch.randn(50, 3, generator=generator, dtype=torch.float64) - 2)
    deviations = torch.exp(torch.randn(50, generator=generator, dtype=torch.float64) - 2)
    before = torch.diag_embed(scales.square())
    after = before + deviations.square()[:, None, None] * torch.eye(3, dtype=torch.float64)
    smoothed, factors = filtered(scales.to(dtype), deviations.to(dtype))
    torch.testing.assert_close(smoothed.double(), after.diagonal(dim1=1, dim2=2).sqrt(), rtol=1e-6, atol=0)
    torch.testing.assert_close(factors.double(), (before.det() / after.det()).sqrt(), rtol=1e-5, atol=0)


def test_gradients_flow_through() -> None:
    """To the scales, as differences say."""
    scales = torch.tensor([[0.1, 0.5, 2.0], [0.01, 0.3, 0.2]], dtype=torch.float64, requires_grad=True)
    deviations = torch.tensor([0.3, 0.1], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda values: filtered(values, deviations), (scales,))


@pytest.mark.parametrize("features", [0, 8])
def test_stored_filter_shows_the_same(features: int) -> None:
    """Scales and every opacity that hold the filter render what the filter renders; with it images are others."""
    capture = toy_capture()
    model = toy_model(toy_config(feature_dim=features, spectra={"thermal": {"opacity": "own"}}), capture)
    frame, gaussians = toy_frame(capture), model.gaussians("shared")
    with torch.no_grad():
        plain = render(model, frame).images
        set_filter(gaussians, sampling_cameras(capture, model.sets_of_spectra)["shared"])
        assert gaussians.filter_3d is not None
        gaussians.filter_3d *= 6.0  # as wide as the toy's Gaussians
        by_filter = render(model, frame).images
        store_filtered(gaussians)
        assert gaussians.filter_3d is None
        stored = render(model, frame).images
    for name, image in by_filter.items():
        torch.testing.assert_close(stored[name], image, rtol=1e-4, atol=2e-5)
        assert (image - plain[name]).abs().max() > 0.01


def test_spectra_have_the_cameras_of_their_set() -> None:
    """A shared set has those of all spectra, each of aligned ones once; separate sets their own."""
    shared = toy_config()
    for aligned, number in ((True, 1), (False, 2)):
        capture = toy_capture(aligned=aligned)
        assert len(sampling_cameras(capture, toy_model(shared, capture).sets_of_spectra)["shared"]) == number
    separate = toy_model(toy_config(gaussian_sets="separate", feature_dim=0), capture)
    found = sampling_cameras(capture, separate.sets_of_spectra)
    assert {name: [one.camera.width for one in cameras] for name, cameras in found.items()} == {
        "rgb": [24],
        "thermal": [16],
    }


def test_a_filter_stays_where_it_is() -> None:
    """Recorded steps read its memory, as long as the number of Gaussians is the same."""
    gaussians = Gaussians({"means": torch.tensor([[0.0, 0.0, 4.0]])})
    set_filter(gaussians, [moved(NARROW, 0.0)])
    first = gaussians.filter_3d
    with torch.no_grad():
        gaussians.means[0, 2] = 2.0
    set_filter(gaussians, [moved(NARROW, 0.0)])
    assert gaussians.filter_3d is first
    torch.testing.assert_close(first, torch.tensor([0.2**0.5 / 60.0]))
