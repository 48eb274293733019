"""Decoders: the formulas, the identity start, the ablation switches, and where gradients go."""

import dataclasses

import numpy as np
import torch

from thermosplat.config import DecoderConfig
from thermosplat.decoders import Decoders


def decoders(thermal_channels: int = 3, **changes) -> Decoders:
    torch.manual_seed(0)
    config = dataclasses.replace(DecoderConfig(hidden_dim=16), **changes)
    return Decoders(config, feature_dim=8, thermal_channels=thermal_channels)


def features() -> torch.Tensor:
    return torch.randn(5, 6, 8, generator=torch.Generator().manual_seed(1))


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def silu(x: np.ndarray) -> np.ndarray:
    return x * sigmoid(x)


def linear(layer: torch.nn.Module, x: np.ndarray) -> np.ndarray:
    weight, bias = (value.detach().double().numpy() for value in (layer.weight, layer.bias))
    return x @ weight.T + bias


def test_formulas() -> None:
    """Both images equal equations 3 to 8 written out in numpy, with a modulation that is not the identity."""
    model = decoders()
    torch.nn.init.normal_(model.modulation.weight, std=0.2)
    x = features()
    a = x.double().numpy()
    h = silu(linear(model.shared_encoder[2], silu(linear(model.shared_encoder[0], a))))
    h_th = silu(linear(model.thermal_prior[0], h))
    modulation = linear(model.modulation, h_th)
    gamma, beta = modulation[..., :16], modulation[..., 16:]
    np.testing.assert_allclose(model.rgb(x).detach(), sigmoid(linear(model.rgb_head, gamma * h + beta)), atol=1e-6)
    np.testing.assert_allclose(model.thermal(x).detach(), sigmoid(linear(model.thermal_head, h_th)), atol=1e-6)


def test_modulation_starts_as_the_identity() -> None:
    """Before training, the modulated RGB branch equals the plain one with the same weights."""
    modulated, plain = decoders(), decoders(modulation=False)
    plain.load_state_dict({k: v for k, v in modulated.state_dict().items() if not k.startswith("modulation")})
    torch.testing.assert_close(modulated.rgb(features()), plain.rgb(features()))


def test_hybrid_starts_near_black() -> None:
    """The decoded part starts at about sigmoid(-4) = 0.018 everywhere, so that the sum starts at the SH colour."""
    torch.manual_seed(0)
    model = Decoders(DecoderConfig(), feature_dim=8, thermal_channels=3)
    decoded = model.rgb(torch.rand(10, 10, 8)).detach()
    assert decoded.max() < 0.025
    assert abs(decoded.mean() - 0.018) < 0.003


def test_without_the_hybrid_sum_rgb_starts_mid_grey() -> None:
    """The RGB head's bias is only for the hybrid sum; alone the head starts unbiased, around 0.5."""
    decoded = decoders(hybrid_rgb=False).rgb(features()).detach()
    assert (decoded - 0.5).abs().mean() < 0.1


def test_without_modulation_rgb_does_not_use_the_thermal_prior() -> None:
    """The "MLP-based" ablation: no gradient from RGB to the thermal prior head, full thermal branch."""
    model = decoders(modulation=False)
    assert model.modulation is None
    model.rgb(features()).sum().backward()
    assert all(p.grad is None for p in model.thermal_prior.parameters())
    model.thermal(features()).sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in model.thermal_prior.parameters())


def test_gradients_of_the_rgb_branch() -> None:
    """RGB trains encoder, modulation and RGB head; the thermal head is not touched."""
    model = decoders()
    torch.nn.init.normal_(model.modulation.weight, std=0.1)  # the prior's gradient is zero while these are
    model.rgb(features()).sum().backward()
    trained = [model.shared_encoder, model.thermal_prior, model.modulation, model.rgb_head]
    assert all(p.grad.abs().sum() > 0 for part in trained for p in part.parameters())
    assert all(p.grad is None for p in model.thermal_head.parameters())


def test_modulation_weights_train_from_the_identity() -> None:
    """Zero weights do not stay zero: they get a gradient in the first step."""
    model = decoders()
    model.rgb(features()).sum().backward()
    assert model.modulation.weight.grad.abs().sum() > 0


def test_one_thermal_channel_or_none() -> None:
    """Radiometric captures have one thermal channel; captures without thermal images have no thermal head."""
    assert decoders(thermal_channels=1).thermal(features()).shape == (5, 6, 1)
    without = decoders(thermal_channels=0)
    assert without.thermal_head is None
    assert without.rgb(features()).shape == (5, 6, 3)


def test_hidden_layers() -> None:
    """The encoder has as many linear layers as asked for, each followed by SiLU."""
    model = decoders(hidden_layers=3)
    assert [type(m).__name__ for m in model.shared_encoder] == ["Linear", "SiLU"] * 3
    assert model.shared_encoder[0].in_features == 8
    assert model.shared_encoder[4].in_features == 16


def test_both_branches_at_once() -> None:
    """The joint pass gives the images and gradients of the two separate ones, with and without modulation."""
    for modulation in (True, False):
        model = decoders(modulation=modulation)
        visible, thermal = features(), features().flip(0)
        weights = [torch.rand(5, 6, 3, generator=torch.Generator().manual_seed(k)) for k in (2, 3)]
        results = []
        for pair in (model.both(visible, thermal), (model.rgb(visible), model.thermal(thermal))):
            loss = sum((image * weight).sum() for image, weight in zip(pair, weights))
            gradients = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
            results.append((*pair, *[g for g in gradients if g is not None]))
        for joint, separate in zip(*results, strict=True):
            torch.testing.assert_close(joint, separate)
