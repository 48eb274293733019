"""Which sets of Gaussians a configuration starts with."""

from typing import Any

import pytest
import torch

from thermosplat.errors import UserError
from thermosplat.initial_gaussians import initial_gaussians
from toy_scene import toy_capture, toy_config


@pytest.mark.parametrize(
    ("model", "features"),
    [
        ({}, {"shared": True}),
        ({"thermal": False}, {"shared": True}),
        ({"thermal": False, "feature_dim": 0}, {"shared": False}),
        ({"gaussian_sets": "separate", "feature_dim": 0}, {"rgb": False, "thermal": False}),
        ({"gaussian_sets": "separate", "feature_dim": 0, "rgb": False}, {"thermal": False}),
    ],
)
def test_sets_and_their_features(model: dict[str, Any], features: dict[str, bool]) -> None:
    """One shared set, or one a modelled spectrum; only a shared one decodes features."""
    sets = initial_gaussians(toy_config(**model), toy_capture())
    assert {name: gaussians.has_features for name, gaussians in sets.items()} == features


def test_colours_of_separate_sets() -> None:
    """The RGB set starts from the points' colours, the thermal set from their grey; both in the same places."""
    sets = initial_gaussians(toy_config(gaussian_sets="separate", feature_dim=0), toy_capture())
    rgb, thermal = sets["rgb"].sh0.detach(), sets["thermal"].sh0.detach()
    assert torch.equal(sets["rgb"].means, sets["thermal"].means)
    assert rgb.std(dim=-1).max() > 0.1
    assert thermal.std(dim=-1).max() < 1e-6


def test_capture_without_a_modelled_spectrum() -> None:
    """A spectrum that is to be modelled must have training images; one that is not need not."""
    rgb_only = toy_capture(thermal=False)
    with pytest.raises(UserError, match="no-thermal"):
        initial_gaussians(toy_config(), rgb_only)
    assert set(initial_gaussians(toy_config(thermal=False), rgb_only)) == {"shared"}
    with pytest.raises(UserError, match="no-rgb"):
        initial_gaussians(toy_config(), toy_capture(rgb=False))
