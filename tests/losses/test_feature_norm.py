"""MS-Splatting's regularisation of features."""

import pytest
import torch

from thermosplat.losses.gaussian_penalties import feature_norm_loss


def test_squared_distance_from_unit_length() -> None:
    """Lengths 1, 3 and 0: mean of 0, 4 and 1; a zero vector has a finite gradient."""
    features = torch.tensor([[0.6, 0.8], [3.0, 0.0], [0.0, 0.0]], requires_grad=True)
    loss = feature_norm_loss(features)
    assert loss.item() == pytest.approx(5.0 / 3.0)
    loss.backward()
    assert torch.isfinite(features.grad).all()
    assert features.grad[1, 0] > 0
