"""Loss weights that follow the sizes of two sets."""

import pytest
import torch

from thermosplat.training.modality_balance import balanced_losses


def test_the_larger_set_weighs_less() -> None:
    """Every term gets the other set's share; with equal sets one half."""
    losses = {"rgb": torch.tensor(2.0), "thermal": torch.tensor(3.0), "thermal_smoothness": torch.tensor(4.0)}
    balanced = balanced_losses(losses, {"rgb": 75, "thermal": 25})
    assert {name: value.item() for name, value in balanced.items()} == pytest.approx(
        {"rgb": 0.5, "thermal": 2.25, "thermal_smoothness": 3.0}
    )
    equal = balanced_losses(losses, {"rgb": 7, "thermal": 7})
    assert equal["rgb"].item() == pytest.approx(1.0)
