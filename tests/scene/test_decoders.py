"""Decoders: the formulas, the identity start, the ablation switches, and where gradients go."""

import dataclasses

import numpy as np
import pytest
import torch

from thermosplat.config import DecoderConfig
from thermosplat.scene.decoder import Decoders
from thermosplat.spectra import Spectrum

RGB = Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal")
THERMAL = Spectrum("thermal", 3, "color", "offset", (3, 4), None)
NIR = Spectrum("nir", 1, "scalar", "shared", (4, 5), None)


def decoders(*spectra: Spectrum, **changes) -> Decoders:
    torch.manual_seed(0)
    config = dataclasses.replace(DecoderConfig(hidden_dim=16), **changes)
    return Decoders(config, feature_dim=8, spectra=spectra or (RGB, THERMAL))


def features() -> torch.Tensor:
    return torch.randn(5, 6, 8, generator=torch.Generator().manual_seed(1))


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def silu(x: np.ndarray) -> np.ndarray:
    return x * sigmoid(x)


def linear(layer: torch.nn.Module, x: np.ndarray) -> np.ndarray:
    weight, bias = (value.detach().double().numpy() for value in (layer.weight, layer.bias))
    return x @ weight.T + bias


def test_images_are_those_of_the_equations() -> None:
    """Both images equal equations 3 to 8 written out in numpy, with a modulation that is not the identity."""
    model = decoders()
    torch.nn.init.normal_(model.modulations["rgb"].weight, std=0.2)
    x = features()
    a = x.double().numpy()
    h = silu(linear(model.shared_encoder[2], silu(linear(model.shared_encoder[0], a))))
    h_th = silu(linear(model.priors["thermal"][0], h))
    modulation = linear(model.modulations["rgb"], h_th)
    gamma, beta = modulation[..., :16], modulation[..., 16:]
    np.testing.assert_allclose(
        model.image("rgb", x).detach(), sigmoid(linear(model.heads["rgb"], gamma * h + beta)), atol=1e-6
    )
    np.testing.assert_allclose(
        model.image("thermal", x).detach(), sigmoid(linear(model.heads["thermal"], h_th)), atol=1e-6
    )


def test_modulation_starts_as_the_identity() -> None:
    """Before training, the modulated RGB branch equals the plain one with the same weights."""
    modulated, plain = decoders(), decoders(modulation=False)
    plain.load_state_dict({k: v for k, v in modulated.state_dict().items() if not k.startswith("modulations")})
    torch.testing.assert_close(modulated.image("rgb", features()), plain.image("rgb", features()))


def test_hybrid_starts_near_black() -> None:
    """The decoded part starts at about sigmoid(-4) = 0.018 everywhere, so that the sum starts at the SH colour."""
    torch.manual_seed(0)
    model = Decoders(DecoderConfig(), feature_dim=8, spectra=(RGB, THERMAL))
    decoded = model.image("rgb", torch.rand(10, 10, 8)).detach()
    assert decoded.max() < 0.025
    assert abs(decoded.mean() - 0.018) < 0.003


def test_without_the_hybrid_sum_rgb_starts_mid_grey() -> None:
    """The RGB head's bias is only for the hybrid sum; alone the head starts unbiased, around 0.5."""
    decoded = decoders(hybrid=False).image("rgb", features()).detach()
    assert (decoded - 0.5).abs().mean() < 0.1


def test_without_modulation_rgb_does_not_use_the_thermal_prior() -> None:
    """The "MLP-based" ablation: no gradient from RGB to the thermal prior head, full thermal branch."""
    model = decoders(modulation=False)
    assert len(model.modulations) == 0
    model.image("rgb", features()).sum().backward()
    assert all(p.grad is None for p in model.priors["thermal"].parameters())
    model.image("thermal", features()).sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in model.priors["thermal"].parameters())


def test_gradients_of_the_rgb_branch() -> None:
    """RGB trains encoder, modulation and RGB head; the thermal head is not touched."""
    model = decoders()
    torch.nn.init.normal_(model.modulations["rgb"].weight, std=0.1)  # the prior's gradient is zero while these are
    model.image("rgb", features()).sum().backward()
    trained = [model.shared_encoder, model.priors["thermal"], model.modulations["rgb"], model.heads["rgb"]]
    assert all(p.grad.abs().sum() > 0 for part in trained for p in part.parameters())
    assert all(p.grad is None for p in model.heads["thermal"].parameters())


def test_modulation_weights_train_from_the_identity() -> None:
    """Zero weights do not stay zero: they get a gradient in the first step."""
    model = decoders()
    model.image("rgb", features()).sum().backward()
    assert model.modulations["rgb"].weight.grad.abs().sum() > 0


def test_channels_of_each_spectrum() -> None:
    """Scalars have one channel; a spectrum that is not modelled has no head, though its prior may modulate another."""
    scalar = dataclasses.replace(THERMAL, channels=1, color_space="scalar")
    assert decoders(RGB, scalar).image("thermal", features()).shape == (5, 6, 1)
    alone = decoders(RGB)
    assert set(alone.heads) == {"rgb"}
    assert set(alone.priors) == {"thermal"}
    assert alone.image("rgb", features()).shape == (5, 6, 3)
    with pytest.raises(KeyError):
        alone.image("thermal", features())


def test_a_third_spectrum_has_a_prior_and_a_head_of_its_own() -> None:
    """Its image trains the shared encoder and those two, and the others start as they do without it."""
    two, three = decoders(), decoders(RGB, THERMAL, NIR)
    shared = {name: value for name, value in three.state_dict().items() if ".nir." not in name}
    assert shared.keys() == two.state_dict().keys()
    assert all(torch.equal(value, two.state_dict()[name]) for name, value in shared.items())
    image = three.image("nir", features())
    assert image.shape == (5, 6, 1)
    image.sum().backward()
    trained = {name for name, parameter in three.named_parameters() if parameter.grad is not None}
    assert {name.rpartition(".")[0] for name in trained} == {
        *("shared_encoder.0", "shared_encoder.2", "priors.nir.0", "heads.nir"),
    }


def test_both_branches_at_once() -> None:
    """The joint pass gives the images and gradients of the two separate ones, with and without modulation."""
    for modulation in (True, False):
        model = decoders(modulation=modulation)
        visible, thermal = features(), features().flip(0)
        weights = [torch.rand(5, 6, 3, generator=torch.Generator().manual_seed(k)) for k in (2, 3)]
        results = []
        joint = model.decode({"rgb": visible, "thermal": thermal})
        assert list(joint) == ["rgb", "thermal"]
        for pair in (tuple(joint.values()), (model.image("rgb", visible), model.image("thermal", thermal))):
            loss = sum((image * weight).sum() for image, weight in zip(pair, weights))
            gradients = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
            results.append((*pair, *[g for g in gradients if g is not None]))
        for joint, separate in zip(*results, strict=True):
            torch.testing.assert_close(joint, separate)
