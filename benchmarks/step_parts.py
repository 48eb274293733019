"""Times the parts of a training step one by one: rasterization, decoders, each loss, optimizer, density control.

On CUDA a part's kernels are recorded as a graph and replayed, so that launching them is not timed; the cache is
overwritten before each replay. A part with a gradient is timed forward, and forward with backward.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import NamedTuple

import torch
from steady_training import wait
from timing import time_interleaved
from torch import Tensor

from thermosplat.config import LossConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.errors import UserError
from thermosplat.gaussian_views import Rendering, see_both
from thermosplat.losses import frame_losses
from thermosplat.model import RenderedFrame
from thermosplat.rasterizer import RGBTRender
from thermosplat.training.optimizers import step_unless
from thermosplat.training.trainer import Trainer
from thermosplat.training.training_step import StepKind
from thermosplat.warp_streams import captured_in

LOSSES = ("rgb", "thermal", "features_rgb", "features_thermal", "thermal_smoothness")
"""Terms of the loss, each the name of its weight in LossConfig."""


class PartTime(NamedTuple):
    """Median milliseconds of a part; backward is None where it has no gradient."""

    forward_ms: float
    backward_ms: float | None = None

    @property
    def total_ms(self) -> float:
        """Both together."""
        return self.forward_ms + (self.backward_ms or 0.0)


def part_times(trainer: Trainer, repeats: int) -> dict[str, PartTime]:
    """Times every part of a trainer's step on its next frame.

    Args:
        trainer: Warm, from ``steady_trainer`` with ``densifying``; one set of Gaussians that both spectra share,
            decoded features, and one camera for both spectra.
        repeats: Measurements of each.

    Raises:
        UserError: The trainer's configuration or capture has other parts.
    """
    state, step = trainer.state, trainer.device_step
    frame = trainer.schedule.tensors(state.step)
    if trainer.model.decoders is None or state.gaussian_sets.keys() != {"shared"} or not frame.aligned:
        raise UserError(
            "The parts of a step are timed for one set of Gaussians with decoded features and one camera for both "
            "spectra.",
            "Take --config thermosplat and an aligned capture, or leave out --parts step.",
        )
    step.capacity.measure()
    on_cuda = trainer.device.type == "cuda"

    def images() -> list[Tensor]:
        return _images(rasterized(trainer, frame, fixed=on_cuda))

    times = {"rasterization": _differentiable(trainer, images, repeats)}
    times["decoders"] = _decoders(trainer, frame, repeats)
    times |= _losses(trainer, frame, repeats)
    times |= _updates(trainer, frame, repeats)
    return times


def rasterized(trainer: Trainer, frame: FrameTensors, *, fixed: bool) -> RGBTRender:
    """The frame's rasterization as the model has it done, from activations to images of colours and features.

    Args:
        trainer: As for :func:`part_times`.
        frame: The frame.
        fixed: With a room for pairs that was measured before, as in a captured step.
    """
    gaussians, config = trainer.state.gaussian_sets["shared"], trainer.config
    how = Rendering(
        trainer.sh_degree, config.densification.absgrad, config.model.rasterize_mode, None, config.deterministic
    )
    opacities = gaussians.thermal_opacities if gaussians.has_two_opacities else None
    with trainer.device_step.capacity.step(fixed=fixed):
        return see_both(gaussians, opacities, gaussians.features, frame.rgb, how)


def _images(render: RGBTRender) -> list[Tensor]:
    images = (render.render_colors, render.render_features, render.render_thermal_features)
    return [image for image in (*images, render.render_alphas, render.render_thermal_alphas) if image is not None]


def _features(render: RGBTRender) -> tuple[Tensor, Tensor]:
    thermal = render.render_thermal_features
    return render.render_features[0], (render.render_features if thermal is None else thermal)[0]


def _leaves(*tensors: Tensor) -> list[Tensor]:
    return [tensor.detach().clone().requires_grad_() for tensor in tensors]


def _decoders(trainer: Trainer, frame: FrameTensors, repeats: int) -> PartTime:
    model, decoders = trainer.model, trainer.model.decoders
    features, thermal_features = _leaves(*_features(rasterized(trainer, frame, fixed=False)))

    def decoded() -> list[Tensor]:
        return list(decoders.both(*model._decoder_inputs(frame.rgb, features, thermal_features)))

    inputs = [features, thermal_features, *decoders.parameters()]
    return _differentiable(trainer, decoded, repeats, inputs, trainer.device_step.decoding)


def _losses(trainer: Trainer, frame: FrameTensors, repeats: int) -> dict[str, PartTime]:
    config = trainer.config.loss
    with torch.no_grad():
        made = trainer.model.render(frame.rgb, frame.thermal, sh_degree=trainer.sh_degree, aligned=True)
    images = _leaves(made.rgb, made.thermal, made.visible_features, made.thermal_features)
    rendered = RenderedFrame(images[0], images[1], images[2], images[3])
    nothing = dict.fromkeys(LOSSES, 0.0)
    times = {}
    for name in LOSSES:
        alone: LossConfig = replace(config, **(nothing | {name: getattr(config, name)}))
        if frame_losses(rendered, frame, alone):
            times[f"loss {name}"] = _differentiable(
                trainer, lambda alone=alone: list(frame_losses(rendered, frame, alone).values()), repeats, images
            )
    return times


def _updates(trainer: Trainer, frame: FrameTensors, repeats: int) -> dict[str, PartTime]:
    """What follows the gradients; they are made once and used again and again."""
    state, step = trainer.state, trainer.device_step
    kind = StepKind(trainer.sh_degree, True)
    state.begin_step(state.step + 1, trainer.config.optimizer, trainer.capture.scene_extent)
    done = step.gradients(frame, kind, fixed_capacity=False)
    blocked = torch.maximum(step.guard.blocked, step.capacity.overflow)
    calls: dict[str, Callable[[], object]] = {
        "finite check": lambda: step.guard.observe(state.step_on_device, done.losses, state.gradients()),
        "optimizer": lambda: [step_unless(blocked, optimizers) for optimizers in state.optimizers.values()],
        "densification": lambda: state.strategies["shared"].observe(done.rendered.infos["shared"], blocked),
    }
    times = _medians(trainer, calls, repeats)
    state.clear_gradients()
    return {name: PartTime(milliseconds) for name, milliseconds in times.items()}


def _differentiable(
    trainer: Trainer,
    forward: Callable[[], list[Tensor]],
    repeats: int,
    inputs: list[Tensor] | None = None,
    around: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> PartTime:
    """Times a part and its gradient to ``inputs``, by default the Gaussians' parameters."""
    leaves = list(trainer.state.gaussian_sets["shared"].parameters()) if inputs is None else inputs
    with around():
        upstream = [torch.full_like(output, 1e-3) for output in forward()]

        def both() -> tuple[Tensor | None, ...]:
            return torch.autograd.grad(forward(), leaves, upstream, allow_unused=True)

        times = _medians(trainer, {"forward": forward, "both": both}, repeats)
    return PartTime(times["forward"], times["both"] - times["forward"])


def _medians(trainer: Trainer, calls: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Milliseconds of calls that take turns."""
    device = trainer.device
    if device.type != "cuda":
        times = time_interleaved(calls, device, repeats)
        return {name: time["median_ms"] for name, time in times.items()}
    graphs, pool = {name: torch.cuda.CUDAGraph() for name in calls}, torch.cuda.MemPool()
    for name, call in calls.items():
        for _ in range(2):  # loads kernels and picks algorithms, which cannot be captured
            call()
        wait(device)
        with captured_in(graphs[name], pool.id):
            call()
    times = time_interleaved({name: graph.replay for name, graph in graphs.items()}, device, repeats, hide_host=True)
    wait(device)
    for graph in graphs.values():
        graph.reset()  # before their pool
    return {name: time["median_ms"] for name, time in times.items()}
