"""Frames as torch tensors: what the model renders from and the losses compare with."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.capture import Frame, View
from thermosplat.radiometry import ThermalScale
from thermosplat.thermal_intensity import thermal_intensity


@dataclass(frozen=True, eq=False)
class ViewTensors:
    """A view on a device.

    Args:
        viewmat: [4, 4] float32, world to camera.
        K: [3, 3] float32 intrinsics [px].
        width: Image width [px].
        height: Image height [px].
        image: [H, W, C] float32 in [0, 1]; None for a camera without an image (novel views).
        intensity: [H, W] float32 thermal intensity in [0, 1]; thermal views only.
        celsius: [H, W] float32 measured temperature [°C]; thermal views that have it only.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    image: Tensor | None = None
    intensity: Tensor | None = None
    celsius: Tensor | None = None


@dataclass(frozen=True, eq=False)
class FrameTensors:
    """A frame on a device; `aligned` as `Frame.aligned`.

    Training frames know their place among them: `index`, int64 scalar on the device.
    """

    name: str
    rgb: ViewTensors | None
    thermal: ViewTensors | None
    aligned: bool
    index: Tensor | None = None


def frame_tensors(frame: Frame, scale: ThermalScale | None, device: torch.device | str) -> FrameTensors:
    """Put a frame on a device.

    Args:
        frame: The frame.
        scale: The capture's thermal scale; None where there is no thermal view.
        device: Where the tensors go.

    Raises:
        ValueError: A thermal view without a scale.
    """
    rgb = None if frame.rgb is None else view_tensors(frame.rgb, None, device)
    if frame.thermal is not None and scale is None:
        raise ValueError(f"Frame {frame.name} has a thermal view, so its capture's thermal scale is needed.")
    thermal = None if frame.thermal is None else view_tensors(frame.thermal, scale, device)
    return FrameTensors(frame.name, rgb, thermal, frame.aligned)


def view_tensors(view: View, scale: ThermalScale | None, device: torch.device | str) -> ViewTensors:
    """Put a view on a device; with a scale also its thermal intensity (inverse palette, or the scalar itself)."""
    image = view.image
    unit = image.astype(np.float32) / np.float32(255) if image.dtype == np.uint8 else image.astype(np.float32)
    pixels = torch.tensor(unit, device=device)
    intensity = None
    if view.modality == "thermal" and scale is not None:
        intensity = _intensity(image, pixels, scale)
    return ViewTensors(
        torch.tensor(view.viewmat, dtype=torch.float32, device=device),
        torch.tensor(view.camera.K, dtype=torch.float32, device=device),
        view.camera.width,
        view.camera.height,
        pixels,
        intensity,
        None if view.celsius is None else torch.tensor(view.celsius, device=device),
    )


def _intensity(image: NDArray[Any], pixels: Tensor, scale: ThermalScale) -> Tensor:
    """Thermal intensity [H, W] of an image as it is stored and as the tensor made of it, on the tensor's device."""
    if scale.kind == "color" and pixels.device.type == "cpu":
        return torch.from_numpy(scale.palette.to_intensity(image))  # each 8-bit colour that occurs is looked up once
    return thermal_intensity(pixels, scale)
