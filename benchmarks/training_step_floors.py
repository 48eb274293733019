"""How fast the parts of a training step could be at best: bytes over bandwidth and operations over peak, both measured.

What is counted, N Gaussians of F floats in all, W·H pixels, C channels of an image:

- Rasterization: the stages of floors.py.
- Decoders: the features read and the images written, and backward the same again, images' gradients read, features'
  gradients written; activations need not leave the chip. Multiply-adds of every linear layer of either branch, and
  backward twice as many. Their peak is float16's matrix products for the precisions "tf32" and "bfloat16".
- An image loss: both images read; backward both again, and the gradient written. Multiply-adds a pixel and channel:
  five moments through 11 taps along two axes (110) and 20 around them; backward three maps (66) and 20.
- Smoothness: the image read; backward read again, and the gradient written.
- Finite check: all gradients read.
- Optimizer (Adam): parameter, gradient and two moments read, three of them written: 28 bytes a float.
- Density control: the means' gradients in the image and radii read (16 bytes), two sums read and written.
"""

from typing import Any

import torch
from device_peaks import DevicePeaks
from floors import stage_floors
from fragments import count_fragments
from step_parts import LOSSES, rasterized
from torch import nn

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.ssim import SSIM_WINDOW
from thermosplat.training.trainer import Trainer

LOSS_FORWARD = 5 * 2 * SSIM_WINDOW + 20
LOSS_BACKWARD = 3 * 2 * SSIM_WINDOW + 20
"""Multiply-adds a pixel and channel."""

ADAM_BYTES, DENSITY_BYTES = 28, 32

FORWARD_STAGES = ("projection", "colors", "binning", "blending")


def step_floors(trainer: Trainer, frame: FrameTensors, peaks: DevicePeaks) -> dict[str, dict[str, Any]]:
    """The floor of every part that ``step_parts.part_times`` times.

    Args:
        trainer: As for ``part_times``.
        frame: The frame that was timed.
        peaks: Measured in the same run.

    Returns:
        For each part ``forward_ms``, ``backward_ms`` (None without one), ``floor_ms`` of both and ``bound``, "bytes" or
        "operations", by which of them most of that is.
    """
    view, gaussians = frame.rgb, trainer.state.gaussian_sets["shared"]
    pixels = view.width * view.height
    floats = sum(parameter.numel() for parameter in gaussians.parameters())
    thermal_channels = frame.thermal.image.shape[-1]
    channels = {"rgb": 3, "thermal": thermal_channels, "features_rgb": 3, "features_thermal": 1}

    def fp32(moved: float, fmas: float = 0.0) -> tuple[float, float]:
        return 1e3 * moved / peaks.bytes_per_s, 2e3 * fmas / peaks.flops_fp32

    floors = {"rasterization": _rasterization(trainer, frame, peaks)}
    floors["decoders"] = _decoders(trainer, pixels, thermal_channels, peaks)
    for name in LOSSES:
        if name == "thermal_smoothness":
            values = pixels * thermal_channels
            floors[f"loss {name}"] = _floor(fp32(4 * values), fp32(8 * values))
        else:
            values = pixels * channels[name]
            floors[f"loss {name}"] = _floor(
                fp32(8 * values, LOSS_FORWARD * values), fp32(12 * values, LOSS_BACKWARD * values)
            )
    floors["finite check"] = _floor(fp32(4 * floats))
    floors["optimizer"] = _floor(fp32(ADAM_BYTES * floats))
    floors["densification"] = _floor(fp32(DENSITY_BYTES * len(gaussians)))
    return floors


def _floor(forward: tuple[float, float], backward: tuple[float, float] | None = None) -> dict[str, Any]:
    """From milliseconds (bytes, operations) of either direction."""
    both = [forward] if backward is None else [forward, backward]
    moved, done = (sum(times[i] for times in both) for i in range(2))
    return {
        "forward_ms": max(forward),
        "backward_ms": None if backward is None else max(backward),
        "floor_ms": sum(max(times) for times in both),
        "bound": "bytes" if moved > done else "operations",
    }


def _rasterization(trainer: Trainer, frame: FrameTensors, peaks: DevicePeaks) -> dict[str, Any]:
    gaussians, view = trainer.state.gaussian_sets["shared"], frame.rgb
    with torch.no_grad():
        info = rasterized(trainer, frame, fixed=False).info
    fragments, pairs = count_fragments(info, view.width, view.height), len(info["flatten_ids"])
    features = gaussians.features.shape[1]
    stages = stage_floors(
        fragments,
        len(gaussians),
        pairs,
        (view.width, view.height),
        info["isect_offsets"].numel(),
        (3 + features, features if gaussians.has_two_opacities else 0),
        peaks,
    )
    forward = sum(stage["floor_ms"] for name, stage in stages.items() if name in FORWARD_STAGES)
    backward = sum(stage["floor_ms"] for name, stage in stages.items() if name not in FORWARD_STAGES)
    by_bytes = sum(stage["floor_ms"] for stage in stages.values() if stage["bound"] == "bytes")
    return {
        "forward_ms": forward,
        "backward_ms": backward,
        "floor_ms": forward + backward,
        "bound": "bytes" if by_bytes > 0.5 * (forward + backward) else "operations",
        "pairs": pairs,
        "tiles": info["isect_offsets"].numel(),
        "fragments": fragments.either,
    }


def _decoders(trainer: Trainer, pixels: int, thermal_channels: int, peaks: DevicePeaks) -> dict[str, Any]:
    fmas = pixels * decoder_fmas(trainer.model.decoders)
    features = trainer.state.gaussian_sets["shared"].features.shape[1]
    rate = peaks.flops_fp32 if trainer.config.decoder_precision == "float32" else peaks.flops_fp16
    moved, images = 4 * pixels * 2 * features, 4 * pixels * (3 + thermal_channels)
    forward = 1e3 * (moved + images) / peaks.bytes_per_s, 2e3 * fmas / rate
    backward = 1e3 * (2 * moved + 2 * images) / peaks.bytes_per_s, 4e3 * fmas / rate
    return _floor(forward, backward)


def decoder_fmas(decoders: nn.Module | None) -> int:
    """Multiply-adds of one pixel in both branches, forward.

    Args:
        decoders: ``Decoders``, whose shared layers both branches pass, or ``SpectrumDecoders``, which share none.
    """
    if decoders is None:
        return 0
    total = 0
    for name, layer in decoders.named_modules():
        if isinstance(layer, nn.Linear):
            shared = name.startswith("shared_encoder") or (name.startswith("thermal_prior") and _modulated(decoders))
            total += layer.weight.numel() * (2 if shared else 1)
    return total


def _modulated(decoders: nn.Module) -> bool:
    return getattr(decoders, "modulation", None) is not None
