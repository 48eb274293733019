"""The scalar intensity of images that are tensors."""

import functools

import torch
from torch import Tensor

from thermosplat.thermal.palette_inverse import Curve, nearest_points
from thermosplat.thermal.radiometry import Palette, PixelScale


def pixel_intensity(image: Tensor, scale: PixelScale) -> Tensor:
    """Scalar intensity of an image.

    Args:
        image: Image, shape [H, W, C]: pseudo-colours for a "color" scale, one channel for a "scalar" one; clamped to
            [0, 1] here.
        scale: What its pixel values mean.

    Returns:
        Intensity in [0, 1], on the image's device, shape [H, W]. For pseudo-colours: of the palette's nearest colour.

    Raises:
        ValueError: The image has colours alone, as photographs have.
    """
    if not scale.has_intensity:
        raise ValueError(f"An image of the kind {scale.kind} has colours, not an intensity.")
    pixels = image.detach().clamp(0, 1)
    if scale.kind == "scalar":
        return pixels[..., 0]
    if pixels.device.type == "cpu":
        return torch.from_numpy(scale.palette.to_intensity(pixels.numpy()))
    curve = _curve_on(scale.palette, pixels.device)
    intensity, _ = nearest_points(pixels.float().reshape(-1, 3).T.contiguous(), curve, torch)  # all pixels at once
    return intensity.reshape(pixels.shape[:-1])


def palette_colors(intensity: Tensor, palette: Palette) -> Tensor:
    """As ``Palette.to_color``, on the intensities' device, without waiting for it.

    Args:
        intensity: [...] in [0, 1]; values outside are clipped.
        palette: The curve.

    Returns:
        Colours [..., 3] in [0, 1].
    """
    colors = _colors_on(palette, intensity.device)
    position = intensity.clamp(0, 1) * (len(colors) - 1)
    segment = position.long().clamp(max=len(colors) - 2)
    fraction = (position - segment)[..., None]
    return colors[segment] * (1 - fraction) + colors[segment + 1] * fraction


@functools.lru_cache(maxsize=8)
def _curve_on(palette: Palette, device: torch.device) -> Curve:
    """The palette's curve on a device, to which it is brought once and not for every image."""
    return Curve(*(torch.tensor(part, device=device) for part in palette.curve))


@functools.lru_cache(maxsize=8)
def _colors_on(palette: Palette, device: torch.device) -> Tensor:
    """The palette's colours on a device, [n, 3]."""
    return torch.tensor(palette.colors, device=device)
