"""Fused kernels decode the modulated spectrum and the one that modulates it; other spectra are decoded beside them."""

from collections.abc import Sequence

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from thermosplat.config import DecoderConfig
from thermosplat.scene.decoder import Decoders
from thermosplat.spectra import Spectrum
from thermosplat.training import fused_decoders
from thermosplat.training.fused_decoders import FusedDecoders, teams

RGB = Spectrum("rgb", 3, "photograph", "shared", (0, 3), "nir")
THERMAL = Spectrum("thermal", 3, "color", "offset", (3, 4), None)
NIR = Spectrum("nir", 1, "scalar", "own", (4, 5), None)
SHAPE = (5, 7, 8)


def branches_by_torch(
    team: int, visible: Tensor | None, thermal: Tensor | None, parameters: Sequence[Tensor | None]
) -> tuple[Tensor | None, Tensor | None]:
    """What the kernels of ``decode_branches`` do, in the order of its parameters."""
    layers = list(zip(parameters[::2], parameters[1::2], strict=True))

    def encoded(features: Tensor) -> tuple[Tensor, Tensor]:
        hidden = F.silu(F.linear(F.silu(F.linear(features, *layers[0])), *layers[1]))
        return hidden, F.silu(F.linear(hidden, *layers[2]))

    image = other = None
    if visible is not None:
        hidden, prior = encoded(visible)
        gamma, beta = F.linear(prior, *layers[3]).chunk(2, dim=-1)
        image = torch.sigmoid(F.linear(gamma * hidden + beta, *layers[4]))
    if thermal is not None:
        other = torch.sigmoid(F.linear(encoded(thermal)[1], *layers[5]))
    return image, other


@pytest.fixture
def decoders(monkeypatch: pytest.MonkeyPatch) -> Decoders:
    """Of three spectra, RGB modulated by the last, with a modulation that does something; kernels by torch."""
    monkeypatch.setattr(fused_decoders, "decode_branches", branches_by_torch)
    generator = torch.Generator().manual_seed(0)
    decoders = Decoders(DecoderConfig(hidden_dim=16), SHAPE[-1], (RGB, THERMAL, NIR))
    for parameter in decoders.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    return decoders


@pytest.mark.parametrize(
    "names", [("rgb", "thermal", "nir"), ("rgb",), ("nir",), ("thermal",), ("thermal", "nir"), ("nir", "rgb")]
)
def test_images_and_gradients_are_the_decoders(decoders: Decoders, names: tuple[str, ...]) -> None:
    """Whichever spectra are asked for, and in their order; every layer that they use gets its gradient."""
    features = {name: torch.randn(SHAPE, generator=torch.Generator().manual_seed(len(name))) for name in names}
    found = []
    for decoded in (FusedDecoders(decoders, 1).decode(features), decoders.decode(features)):
        assert list(decoded) == list(names)
        decoders.zero_grad()
        torch.stack([image.square().sum() for image in decoded.values()]).sum().backward()
        gradients = {name: p.grad.clone() for name, p in decoders.named_parameters() if p.grad is not None}
        found.append(({name: image.detach() for name, image in decoded.items()}, gradients))
    (images, gradients), (true_images, true_gradients) = found
    torch.testing.assert_close(images, true_images)
    torch.testing.assert_close(gradients, true_gradients)


def test_decoders_without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two modulations, or none: the kernels know neither, whatever the device has room for."""
    monkeypatch.setattr(fused_decoders, "teams_of_shape", lambda device, hidden, features: (hidden, features))
    twice = (RGB, Spectrum("thermal", 3, "color", "offset", (3, 4), "nir"), NIR)
    three = (RGB, THERMAL, NIR)
    assert teams(Decoders(DecoderConfig(hidden_dim=32), 8, three)) == (32, 8)
    for config, spectra in (
        (DecoderConfig(), twice),
        (DecoderConfig(modulation=False), three),
    ):
        assert teams(Decoders(config, 8, spectra)) == ()
