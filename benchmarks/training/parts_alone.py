"""Parts of a training step that kernel names cannot tell apart, timed alone: each loss, bookkeeping, the finite check.

On CUDA a part's time is the sum of its kernels' times as the profiler sees them, so that launching them is not timed;
what they read may lie in the cache, as in a step. Backward is the time of both directions less that of forward.

Floors are bytes over the measured bandwidth: an image loss reads both images, backward both again, and writes the
gradient (20 a channel and pixel); smoothness reads the image twice and writes the gradient (12); the finite check reads
all gradients; bookkeeping for density control reads the gradients of the means in the image and who is visible (9 a
Gaussian), and reads and writes two sums (16).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from measuring.device_peaks import DevicePeaks
from measuring.timing import time_interleaved
from thermosplat.config import TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.losses.image_terms import compare_frame, image_terms
from thermosplat.scene.model import RenderedFrame
from thermosplat.training.optimizers import gradients_to_watch
from thermosplat.training.step_kind import StepKind
from thermosplat.training.trainer import Trainer
from training.step_parts import profiled

IMAGE_LOSS_BYTES, SMOOTHNESS_BYTES, FINITE_BYTES, DENSITY_BYTES = 20, 12, 4, 25

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
    config = trainer.config
    with torch.no_grad():
        made = trainer.model.render(frame.views, sh_degree=trainer.sh_degree, shared_cameras=frame.shared_cameras)
        terms = compare_frame(made, frame, config).spectra
    rendered = RenderedFrame(
        images={name: image.clone().requires_grad_() for name, image in made.images.items()},
        features={name: features.clone().requires_grad_() for name, features in made.features.items()},
    )
    leaves = [*rendered.images.values(), *rendered.features.values()]
    parts: dict[str, Part] = {}
    for name, spectrum in terms.items():
        alone = _with_one_term(config, name)

        def forward(alone: TrainConfig = alone) -> Tensor:
            return torch.stack(list(compare_frame(rendered, frame, alone).losses.values())).sum()

        def both(forward: Callable[[], Tensor] = forward) -> object:
            return torch.autograd.grad(forward(), leaves, allow_unused=True)

        times = _milliseconds(trainer, {"forward": forward, "both": both}, repeats)
        compared = image_terms(rendered, frame, alone)
        if compared:
            moved = IMAGE_LOSS_BYTES * sum(term.render.numel() for term in compared)
        else:
            moved = SMOOTHNESS_BYTES * rendered.images[spectrum].numel()
        parts[f"loss {name}"] = _part(times["forward"], times["both"] - times["forward"], moved, peaks)
    return parts


def _with_one_term(config: TrainConfig, name: str) -> TrainConfig:
    """A configuration whose loss has one term alone, named as ``compare_frame`` names it."""
    spectra = {}
    for spectrum, settings in config.spectra.items():
        weights = {"loss": spectrum, "features": f"features_{spectrum}", "smoothness": f"{spectrum}_smoothness"}
        others = {field for field, term in weights.items() if term != name and getattr(settings, field) is not None}
        spectra[spectrum] = replace(settings, **dict.fromkeys(others, 0.0))
    return replace(config, spectra=spectra)


def _bookkeeping(trainer: Trainer, frame: FrameTensors, peaks: DevicePeaks, repeats: int) -> dict[str, Part]:
    state, step = trainer.state, trainer.device_step
    done = step.gradients(
        [frame], StepKind(trainer.sh_degree, densifying=True), trainer.steps.plan(), fixed_capacity=False
    )
    blocked = torch.maximum(step.guard.blocked, step.capacity.overflow)

    def noted() -> None:
        for name, strategy in state.strategies.items():
            strategy.observe(done.rendered.infos.get(name, []), blocked)

    calls: dict[str, Callable[[], object]] = {
        "finite check": lambda: step.guard.observe(
            state.step_on_device, done.losses, gradients_to_watch(state.optimizers)
        ),
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
