"""Which sets of Gaussians a configuration starts with."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.config import DensificationConfig, ResolutionConfig, TrainConfig
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import AMONG_MANY, initial_gaussians
from thermosplat.scene.neighbor_distances import neighbor_distances
from thermosplat.spectra import model_spectra
from toy_scene import toy_capture, toy_config


def sets_of(config: TrainConfig, capture: Capture) -> dict[str, Gaussians]:
    color_spaces = {name: capture.scales[name].kind for name in config.modelled}
    formations = Formations(config.model, config.decoder, model_spectra(config.modelled, color_spaces))
    return initial_gaussians(config, capture, formations)


@pytest.mark.parametrize(
    ("model", "features"),
    [
        ({}, {"shared": True}),
        ({"without": ("thermal",)}, {"shared": True}),
        ({"without": ("thermal",), "feature_dim": 0}, {"shared": False}),
        ({"gaussian_sets": "separate", "feature_dim": 0}, {"rgb": False, "thermal": False}),
        ({"gaussian_sets": "separate", "feature_dim": 0, "without": ("rgb",)}, {"thermal": False}),
    ],
)
def test_sets_and_their_features(model: dict[str, Any], features: dict[str, bool]) -> None:
    """One shared set, or one per modelled spectrum; only a shared one decodes features."""
    sets = sets_of(toy_config(**model), toy_capture())
    assert {name: gaussians.has_features for name, gaussians in sets.items()} == features


def test_colours_of_separate_sets() -> None:
    """The RGB set starts from the points' colours, the thermal set from their grey; both in the same places."""
    sets = sets_of(toy_config(gaussian_sets="separate", feature_dim=0), toy_capture())
    rgb, thermal = sets["rgb"].sh0.detach(), sets["thermal"].sh0.detach()
    assert torch.equal(sets["rgb"].means, sets["thermal"].means)
    assert rgb.std(dim=-1).max() > 0.1
    assert thermal.std(dim=-1).max() < 1e-6


@pytest.mark.parametrize(
    ("spacing", "strategy", "factors", "share"),
    [
        (0.009, "mcmc", (4,), AMONG_MANY),
        (0.012, "mcmc", (4,), 1.0),
        (0.009, "mcmc", (), 1.0),  # more than a pixel of the first images
        (0.009, "default", (4,), 1.0),
    ],
)
def test_first_sizes(spacing: float, strategy: str, factors: tuple[int, ...], share: float) -> None:
    """Gaussians that grow by MCMC start a tenth as wide as usual where points lie close together in the images."""
    capture = toy_capture()
    name, view = next(iter(capture.train[0].views.items()))
    view = replace(view, camera=view.camera.resized(240, 180))
    depth = 2.0
    # of a grid before the camera, whose corners have two neighbours of three
    step = spacing * view.camera.width * depth / view.camera.fx
    x, y = np.meshgrid(np.arange(-3, 4) * step, np.arange(-3, 4) * step)
    in_camera = np.stack([x, y, np.full_like(x, depth), np.ones_like(x)], axis=-1).reshape(-1, 4)
    points = (in_camera @ np.linalg.inv(view.viewmat).T)[:, :3].astype(np.float32)
    dense = replace(capture, train=(Frame("a", {name: view}),), points=points, point_colors=np.zeros((49, 3), np.uint8))
    config = replace(
        toy_config(),
        densification=DensificationConfig(strategy=strategy),
        resolution=ResolutionConfig(factors=factors, until=tuple(0.1 for _ in factors)),
    )
    sizes = sets_of(config, dense)["shared"].scales.detach().numpy()
    np.testing.assert_allclose(sizes, share * neighbor_distances(points)[:, None].repeat(3, 1), rtol=1e-5)
