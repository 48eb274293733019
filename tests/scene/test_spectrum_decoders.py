"""A network for each spectrum: shapes, independence, and which decoders a configuration makes."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from thermosplat.config import DecoderConfig
from thermosplat.scene.decoder import Decoders, SpectrumDecoders
from thermosplat.scene.formations.kinds import make_decoder
from thermosplat.spectra import Spectrum

RGB = Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal")
THERMAL = Spectrum("thermal", 3, "color", "offset", (3, 4), None)
SCALAR = replace(THERMAL, channels=1, color_space="scalar")
CONFIG = DecoderConfig(hidden_dim=8, branches="separate", modulation=False)


def test_images_and_their_ranges() -> None:
    """Three colours and as many thermal channels as asked for, all in (0, 1)."""
    decoders = SpectrumDecoders(CONFIG, 6, [RGB, SCALAR])
    images = decoders.decode({name: 5 * torch.randn(4, 5, 6) for name in ("rgb", "thermal")})
    rgb, thermal = images["rgb"], images["thermal"]
    assert (rgb.shape, thermal.shape) == ((4, 5, 3), (4, 5, 1))
    assert min(rgb.min(), thermal.min()) > 0
    assert max(rgb.max(), thermal.max()) < 1


def test_spectra_share_no_parameter() -> None:
    """An image trains its own network alone."""
    decoders = SpectrumDecoders(CONFIG, 6, [RGB, THERMAL])
    decoders.image("thermal", torch.randn(4, 5, 6)).sum().backward()
    trained = {name.split(".")[1] for name, parameter in decoders.named_parameters() if parameter.grad is not None}
    assert trained == {"thermal"}


def test_widths_of_the_layers() -> None:
    """Hidden layers as configured: input, one hidden layer, output."""
    shapes = [tuple(p.shape) for p in SpectrumDecoders(CONFIG, 6, [RGB]).networks["rgb"].parameters() if p.dim() == 2]
    assert shapes == [(8, 6), (8, 8), (3, 8)]


def test_hybrid_sum_starts_at_the_sh_colour() -> None:
    """The decoded part that is added to it starts near black, as with joined branches, the thermal image mid-grey."""
    torch.manual_seed(0)
    decoders = SpectrumDecoders(replace(CONFIG, hybrid=True), 6, [RGB, THERMAL])
    images = decoders.decode(dict(zip(("rgb", "thermal"), torch.rand(2, 10, 10, 6))))
    rgb, thermal = (image.detach() for image in images.values())
    assert rgb.max() < 0.03
    assert abs(rgb.mean() - 0.018) < 0.003
    assert abs(thermal.mean() - 0.5) < 0.15


def test_without_hybrid_sum_networks_start_alike() -> None:
    """A decoded image alone starts where PyTorch's layers do."""
    torch.manual_seed(0)
    network = SpectrumDecoders(replace(CONFIG, hybrid=False), 6, [RGB, THERMAL]).networks["rgb"]
    torch.manual_seed(0)
    plain = [nn.Linear(6, 8), nn.Linear(8, 8), nn.Linear(8, 3)]
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    assert all(torch.equal(ours.weight, theirs.weight) for ours, theirs in zip(layers, plain, strict=True))
    assert all(torch.equal(ours.bias, theirs.bias) for ours, theirs in zip(layers, plain, strict=True))


def test_a_spectrum_that_is_not_decoded() -> None:
    """A model of RGB alone has no thermal network."""
    with pytest.raises(KeyError):
        SpectrumDecoders(CONFIG, 6, [RGB]).image("thermal", torch.zeros(2, 2, 6))


def test_configuration_decides() -> None:
    """Joined or separate branches; a viewing direction adds three inputs, a frequency twice the features."""
    assert isinstance(make_decoder(CONFIG, 6, [RGB, THERMAL]), SpectrumDecoders)
    joined = make_decoder(DecoderConfig(hidden_dim=8, view_direction=True), 6, [RGB, THERMAL])
    assert isinstance(joined, Decoders)
    assert joined.image("rgb", torch.zeros(2, 2, 9)).shape == (2, 2, 3)
    both = make_decoder(DecoderConfig(hidden_dim=8, view_direction=True, fourier_frequency=3.0), 6, [RGB, THERMAL])
    assert both.image("rgb", torch.zeros(2, 2, 21)).shape == (2, 2, 3)
