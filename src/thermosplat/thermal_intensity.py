"""The scalar intensity of thermal images that are tensors."""

import torch
from torch import Tensor

from thermosplat.palette_inverse import Curve, nearest_points
from thermosplat.radiometry import Palette, ThermalScale


def thermal_intensity(image: Tensor, scale: ThermalScale) -> Tensor:
    """Scalar intensity of a thermal image.

    Args:
        image: Thermal image, shape [H, W, C]: pseudo-colours for a "color" scale, one channel for a "scalar" one;
            clamped to [0, 1] here.
        scale: What thermal pixel values mean.

    Returns:
        Intensity in [0, 1], on the image's device, shape [H, W]. For pseudo-colours: of the palette's nearest colour.
    """
    pixels = image.detach().clamp(0, 1)
    if scale.kind == "scalar":
        return pixels[..., 0]
    if pixels.device.type == "cpu":
        return torch.from_numpy(scale.palette.to_intensity(pixels.numpy()))
    return _inverted(pixels, scale.palette)


def _inverted(colors: Tensor, palette: Palette) -> Tensor:
    """As ``Palette.to_intensity``, on the colours' device, which takes all pixels at once and is never waited for."""
    curve = Curve(*(torch.tensor(part, device=colors.device) for part in palette.curve))
    intensity, _ = nearest_points(colors.float().reshape(-1, 3).T.contiguous(), curve, torch)
    return intensity.reshape(colors.shape[:-1])
