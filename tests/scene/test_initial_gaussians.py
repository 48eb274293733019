"""Which sets of Gaussians a configuration starts with."""

from typing import Any

import pytest
import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.initial_gaussians import initial_gaussians
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
