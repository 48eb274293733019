"""Penalties on opacities and scales."""

import pytest
import torch

from thermosplat.config import LossConfig
from thermosplat.gaussian_penalties import gaussian_penalties
from thermosplat.gaussians import Gaussians


def faint(opacity: float, thermal_opacity: float | None, scale: float) -> Gaussians:
    parameters = {
        "means": torch.zeros(2, 3),
        "log_scales": torch.full((2, 3), scale).log(),
        "logit_opacities": torch.logit(torch.full((2,), opacity)),
    }
    if thermal_opacity is not None:
        parameters["logit_thermal_opacities"] = torch.logit(torch.full((2,), thermal_opacity))
    return Gaussians(parameters)


def test_weighted_means_of_all_sets() -> None:
    """Each opacity there is counts by its mean; sets add up; scales count in scene extents."""
    config = LossConfig(opacity_reg=0.5, scale_reg=2.0)
    shared = gaussian_penalties({"shared": faint(0.2, 0.6, 0.1)}, config, 1.0)
    assert {name: term.item() for name, term in shared.items()} == pytest.approx({"opacity_reg": 0.4, "scale_reg": 0.2})
    separate = gaussian_penalties({"rgb": faint(0.2, None, 0.1), "thermal": faint(0.6, None, 0.3)}, config, 2.0)
    assert separate["opacity_reg"].item() == pytest.approx(0.4)
    assert separate["scale_reg"].item() == pytest.approx(0.4)


def test_no_weight_no_term() -> None:
    """By default there is no penalty."""
    assert gaussian_penalties({"shared": faint(0.2, 0.6, 0.1)}, LossConfig(), 1.0) == {}
