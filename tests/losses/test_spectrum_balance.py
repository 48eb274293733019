"""Loss weights that follow the sizes of two sets."""

import pytest
import torch

from thermosplat.losses.image_terms import balanced_losses


def test_the_larger_set_weighs_less() -> None:
    """Every term gets the other set's share; with equal sets one half."""
    losses = {"rgb": torch.tensor(2.0), "thermal": torch.tensor(3.0), "thermal_smoothness": torch.tensor(4.0)}
    spectra = {"rgb": "rgb", "thermal": "thermal", "thermal_smoothness": "thermal"}
    balanced = balanced_losses(losses, spectra, {"rgb": 75, "thermal": 25})
    assert {name: value.item() for name, value in balanced.items()} == pytest.approx(
        {"rgb": 0.5, "thermal": 2.25, "thermal_smoothness": 3.0}
    )
    equal = balanced_losses(losses, spectra, {"rgb": 7, "thermal": 7})
    assert equal["rgb"].item() == pytest.approx(1.0)


def test_factors_of_three_sets_add_up_to_one() -> None:
    """Factors add up to 1; a term of no spectrum stays as it is."""
    losses = {
        "rgb": torch.tensor(1.0),
        "thermal": torch.tensor(1.0),
        "nir": torch.tensor(1.0),
        "norm": torch.tensor(5.0),
    }
    spectra = {name: name for name in ("rgb", "thermal", "nir")}
    balanced = balanced_losses(losses, spectra, {"rgb": 60, "thermal": 30, "nir": 10})
    assert {name: value.item() for name, value in balanced.items()} == pytest.approx(
        {"rgb": 0.2, "thermal": 0.35, "nir": 0.45, "norm": 5.0}
    )
