"""A network for each spectrum: shapes, independence, and which decoders a configuration makes."""

import pytest
import torch

from thermosplat.config import DecoderConfig
from thermosplat.decoders import Decoders
from thermosplat.spectrum_decoders import SpectrumDecoders, make_decoders

CONFIG = DecoderConfig(hidden_dim=8, hidden_layers=2, branches="separate", modulation=False)


def test_images_and_their_ranges() -> None:
    """Three colours and as many thermal channels as asked for, all in (0, 1)."""
    decoders = SpectrumDecoders(CONFIG, 6, thermal_channels=1)
    rgb, thermal = decoders.both(5 * torch.randn(4, 5, 6), 5 * torch.randn(4, 5, 6))
    assert (rgb.shape, thermal.shape) == ((4, 5, 3), (4, 5, 1))
    assert min(rgb.min(), thermal.min()) > 0
    assert max(rgb.max(), thermal.max()) < 1


def test_spectra_share_no_parameter() -> None:
    """An image trains its own network alone."""
    decoders = SpectrumDecoders(CONFIG, 6, thermal_channels=3)
    decoders.thermal(torch.randn(4, 5, 6)).sum().backward()
    trained = {name.split(".")[0] for name, parameter in decoders.named_parameters() if parameter.grad is not None}
    assert trained == {"thermal_network"}


def test_widths() -> None:
    """Hidden layers as configured: input, one hidden layer, output."""
    shapes = [tuple(p.shape) for p in SpectrumDecoders(CONFIG, 6, 3).rgb_network.parameters() if p.dim() == 2]
    assert shapes == [(8, 6), (8, 8), (3, 8)]


def test_without_thermal_channels() -> None:
    """A model of RGB alone has no thermal network."""
    with pytest.raises(ValueError, match="thermal_channels=0"):
        SpectrumDecoders(CONFIG, 6, thermal_channels=0).thermal(torch.zeros(2, 2, 6))


def test_configuration_decides() -> None:
    """Joined or separate branches; a viewing direction adds three inputs."""
    assert isinstance(make_decoders(CONFIG, 6, 3), SpectrumDecoders)
    joined = make_decoders(DecoderConfig(hidden_dim=8, view_direction=True), 6, 3)
    assert isinstance(joined, Decoders)
    assert joined.rgb(torch.zeros(2, 2, 9)).shape == (2, 2, 3)
