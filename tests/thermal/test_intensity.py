"""The intensity of images, on the device where they are."""

import pytest
import torch

from thermosplat.thermal.intensity import palette_colors, pixel_intensity
from thermosplat.thermal.radiometry import FLIR_IRON, PixelScale

COLOR, SCALAR = PixelScale("color", FLIR_IRON), PixelScale("scalar", FLIR_IRON)


def test_of_pseudo_colours_and_of_scalars(device: torch.device) -> None:
    """The palette's inverse for colour captures, the channel itself for scalar ones; clamped first."""
    intensity = torch.linspace(0, 1, 35).reshape(5, 7)
    colors = torch.as_tensor(FLIR_IRON.to_color(intensity.numpy()), device=device)
    intensity = intensity.to(device)
    torch.testing.assert_close(pixel_intensity(colors, COLOR), intensity, atol=2e-3, rtol=0)
    torch.testing.assert_close(pixel_intensity(3 * intensity[..., None], SCALAR), (3 * intensity).clamp(0, 1))


def test_colors_of_intensities(device: torch.device) -> None:
    """As the palette's own on the host: at its ends and entries, between them, and clipped outside."""
    intensity = torch.linspace(-0.2, 1.2, 1401).reshape(3, -1)
    expected = torch.from_numpy(FLIR_IRON.to_color(intensity.numpy())).float()
    torch.testing.assert_close(palette_colors(intensity.to(device), FLIR_IRON).cpu(), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("scale", [COLOR, SCALAR], ids=["color", "scalar"])
def test_no_gradient(scale: PixelScale, device: torch.device) -> None:
    """Of an image that asks for a gradient, the intensity asks for none."""
    image = torch.rand(3, 4, scale.channels, device=device, requires_grad=True)
    assert not pixel_intensity(image, scale).requires_grad


def test_of_a_photograph_there_is_none() -> None:
    """Colours have no order."""
    with pytest.raises(ValueError, match="not an intensity"):
        pixel_intensity(torch.rand(3, 4, 3), PixelScale("photograph"))


@pytest.mark.cuda
def test_of_noise_is_the_same_on_a_gpu() -> None:
    """Also beside the palette's curve and out of range, a GPU finds the point that the CPU finds."""
    image = torch.rand(300, 400, 3, generator=torch.Generator().manual_seed(0)) * 1.4 - 0.2
    on_gpu = pixel_intensity(image.cuda(), COLOR)
    torch.testing.assert_close(on_gpu.cpu(), pixel_intensity(image, COLOR), atol=1e-6, rtol=0)
