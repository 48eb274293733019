"""Parts of a training step that kernel names cannot tell apart, timed alone: each loss, bookkeeping, the finite check.

On CUDA a part's time is the sum of its kernels' times as the profiler sees them, so that launching them is not timed;
what they read may lie in the cache, as in a step. Backward is the time of both directions less that of forward.

Floors are bytes over the measured bandwidth: an image loss reads both images, backward both again, and writes the
gradient (20 a channel and pixel); smoothness reads the image twice and writes the gradient (12); the finite check reads
all gradients; bookkeeping for density control reads the gradients of the means in the image and radii (16 a Gaussian)
and reads and writes two sums (16).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from device_peaks import DevicePeaks
from step_parts import profiled
from timing import time_interleaved
from torch import Tensor

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.losses import frame_losses
from thermosplat.model import RenderedFrame
from thermosplat.training.trainer import Trainer
from thermosplat.training.training_step import StepKind

LOSSES = ("rgb", "thermal", "features_rgb", "features_thermal", "thermal_smoothness")
"""Terms of the loss; each is the name of its weight in LossConfig."""

IMAGE_LOSS_BYTES, SMOOTHNESS_BYTES, FINITE_BYTES, DENSITY_BYTES = 20, 12, 4, 32

Part = dict[str, Any]


def parts_alone(trainer: Trainer, peaks: DevicePeaks, repeats: int) -> dict[str, Part]:
    """Times the parts on a trainer's first frame.

    Args:
        trainer: Frozen and warm. Its sums for density control are counted up.
        peaks: Measured.
        repeats: Measurements of each.

    Returns:
        By part ``forward_ms``, ``backward_ms`` (None without one), ``floor_ms`` of both, and ``times_floor``.
    """
    frame = trainer.frames[0]
    return _losses(trainer, frame, peaks, repeats) | _bookkeeping(trainer, frame, peaks, repeats)


def _losses(trainer: Trainer, frame: FrameTensors, peaks: DevicePeaks, repeats: int) -> dict[str, Part]:
    config = trainer.config.loss
    with torch.no_grad():
        made = trainer.model.render(frame.rgb, frame.thermal, sh_degree=trainer.sh_degree, aligned=frame.aligned)
    names = ("rgb", "thermal", "visible_features", "thermal_features")
    images = {
        name: image.clone().requires_grad_() for name in names if (image := getattr(made, name, None)) is not None
    }
    rendered, leaves = RenderedFrame(**images), list(images.values())
    nothing = dict.fromkeys(LOSSES, 0.0)
    parts: dict[str, Part] = {}
    for name in LOSSES:
        alone = replace(config, **(nothing | {name: getattr(config, name)}))
        with torch.no_grad():
            if not frame_losses(rendered, frame, alone):
                continue

        def forward(alone: Any = alone) -> Tensor:
            return torch.stack(list(frame_losses(rendered, frame, alone).values())).sum()

        def both(forward: Callable[[], Tensor] = forward) -> object:
            return torch.autograd.grad(forward(), leaves, allow_unused=True)

        times = _milliseconds(trainer, {"forward": forward, "both": both}, repeats)
        image = rendered.rgb if name in ("rgb", "features_rgb") else rendered.thermal
        channels = {"features_rgb": 3, "features_thermal": 1}.get(name)
        size = SMOOTHNESS_BYTES if name == "thermal_smoothness" else IMAGE_LOSS_BYTES
        moved = size * (image[..., :channels].numel() if image is not None else 0)
        parts[f"loss {name}"] = _part(times["forward"], times["both"] - times["forward"], moved, peaks)
    return parts


def _bookkeeping(trainer: Trainer, frame: FrameTensors, peaks: DevicePeaks, repeats: int) -> dict[str, Part]:
    state, step = trainer.state, trainer.device_step
    done = step.gradients(frame, StepKind(trainer.sh_degree, densifying=True), fixed_capacity=False)
    blocked = torch.maximum(step.guard.blocked, step.capacity.overflow)

    def noted() -> None:
        for name, strategy in state.strategies.items():
            strategy.observe(done.rendered.infos.get(name, []), blocked)

    calls: dict[str, Callable[[], object]] = {
        "finite check": lambda: step.guard.observe(state.step_on_device, done.losses, state.gradients_to_watch()),
        "densification bookkeeping": noted,
    }
    times = _milliseconds(trainer, calls, repeats)
    state.clear_gradients()
    stored = sum(parameter.numel() for parameter in trainer.model.parameters())
    moved = {
        "finite check": FINITE_BYTES * stored,
        "densification bookkeeping": DENSITY_BYTES * trainer.model.num_gaussians,
    }
    return {name: _part(milliseconds, None, moved[name], peaks) for name, milliseconds in times.items()}


def _part(forward_ms: float, backward_ms: float | None, moved: int, peaks: DevicePeaks) -> Part:
    floor_ms = 1e3 * moved / peaks.bytes_per_s
    return {
        "forward_ms": forward_ms,
        "backward_ms": backward_ms,
        "floor_ms": floor_ms,
        "times_floor": (forward_ms + (backward_ms or 0.0)) / floor_ms,
    }


def _milliseconds(trainer: Trainer, calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Milliseconds of calls: on CUDA of their kernels, elsewhere the median of calls that take turns."""
    device = trainer.device
    if device.type != "cuda":
        return {name: time["median_ms"] for name, time in time_interleaved(calls, device, repeats).items()}
    times = {}
    for name, call in calls.items():

        def repeated(call: Callable[[], object] = call) -> None:
            for _ in range(repeats):
                call()

        repeated()  # loads kernels and picks algorithms
        times[name] = sum(kernel["microseconds"] for kernel in profiled(repeated, repeats, device)) / 1e3
    return times
