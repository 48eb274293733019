"""Sines and cosines beside features."""

import pytest
import torch

from thermosplat.scene.decoder import num_inputs, with_fourier_features


def test_values_and_gradients() -> None:
    """[f, sin ωf, cos ωf], with the derivative 1 + ω cos ωf - ω sin ωf of their sum."""
    features = torch.linspace(-2, 2, 24, dtype=torch.float64).reshape(2, 3, 4).requires_grad_()
    inputs = with_fourier_features(features, 3.0)
    expected = torch.stack([features, torch.sin(3 * features), torch.cos(3 * features)], -2).reshape(2, 3, 12)
    torch.testing.assert_close(inputs, expected)
    (slope,) = torch.autograd.grad(inputs.sum(), features)
    torch.testing.assert_close(slope, 1 + 3 * torch.cos(3 * features) - 3 * torch.sin(3 * features))


@pytest.mark.parametrize("frequency", [0.0, 0.5])
def test_number_of_inputs(frequency: float) -> None:
    """What the networks are made for is what they are given."""
    assert with_fourier_features(torch.zeros(5, 8), frequency).shape == (5, num_inputs(8, frequency))


def test_no_frequency() -> None:
    """Then features are passed on, not copied."""
    features = torch.ones(2, 3)
    assert with_fourier_features(features, 0.0) is features
