"""Training steps side by side on one capture and one fixed set of Gaussians, in windows that take turns."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
import torch
from gsplat_rgbt_adapter import Gsplat, GsplatTraining
from steady_training import run_steps, steady_config, steady_trainer, wait, warm_up

from thermosplat.config import TrainConfig
from thermosplat.config_files import load_config
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.errors import UserError
from thermosplat.gaussians import Gaussians
from thermosplat.model import SceneModel
from thermosplat.training.trainer import Trainer
from thermosplat.training.training_step import StepKind

OURS, PLAIN, OURS_RGB = "thermosplat", "thermosplat, plain loop", "thermosplat 3dgs, RGB alone"
TWO_CALLS, GSPLAT_RGB = "gsplat called twice", "gsplat, RGB alone"

COMPARED_FRAMES = 3
LOSS_TOLERANCE, TIMED_TOLERANCE = 2e-3, 2e-2
"""Largest relative difference of a loss term between the rasterizers, with the decoders in float32 on both sides, and
as timed. The rasterizers decide differently in single pixels; the decoders of the timed steps round the inputs of
matrix products to 10 bits (--decoder-precision tf32), which smoothness, a sum of small differences, feels most."""


@dataclass(frozen=True)
class Contestant:
    """Something that does training steps.

    Attributes:
        run: does so many steps and returns the seconds until the device has done them.
        losses: loss terms of a frame; None where they are not those of the others.
        plain_losses: with plain decoders in float32, where the steps have others.
    """

    run: Callable[[int], float]
    losses: Callable[[FrameTensors], dict[str, float]] | None = None
    plain_losses: Callable[[FrameTensors], dict[str, float]] | None = None


def compare_steps(
    config: TrainConfig,
    capture: Capture,
    checkpoint: dict[str, Any],
    gsplat: Gsplat | None,
    *,
    rounds: int,
    window: int,
    with_plain: bool,
) -> dict[str, Any]:
    """Checks that losses agree, then times windows of steps in turns.

    Args:
        config: The whole configuration: one set of Gaussians with decoded features.
        capture: Frames; RGB and thermal views of one camera.
        checkpoint: Of that configuration: the Gaussians.
        gsplat: The peer; None: thermosplat alone.
        rounds: Windows of each.
        window: Steps of a window.
        with_plain: Also time thermosplat's loop with ``--no-graph --no-compile``.

    Returns:
        ``losses`` (each term ours and gsplat's, and their largest relative difference with plain decoders and as
        timed), ``disagreement`` (what is beyond the tolerances, or None), and ``steps``: milliseconds, steps a second
        and the ratio to ours of every contestant.

    Raises:
        UserError: The configuration or the capture is of another kind.
    """
    with TemporaryDirectory() as folder:
        config = steady_config(config, densifying=False)
        ours = steady_trainer(config, capture, Path(folder) / "ours", checkpoint=checkpoint)
        frames = [ours.frames[index] for index in range(len(ours.frames))]
        if ours.model.decoders is None or not all(frame.aligned for frame in frames):
            raise UserError(
                "Steps are compared for one set of Gaussians with decoded features and one camera for both spectra.",
                "Take --config thermosplat and an aligned capture, or leave out --parts peers.",
            )
        contestants = _contestants(ours, frames, Path(folder), checkpoint, gsplat, with_plain)
        for contestant in contestants.values():
            contestant.run(2)
        losses = _compared_losses(contestants, frames[:COMPARED_FRAMES])
        seconds: dict[str, list[float]] = {name: [] for name in contestants}
        for _ in range(rounds):
            for name, contestant in contestants.items():
                seconds[name].append(contestant.run(window))
    view = frames[0].rgb
    return {
        "capture": capture.name,
        "gaussians": ours.model.num_gaussians,
        "size": f"{view.width}x{view.height}" if view else "",
        "frames": len(frames),
        "window": window,
        "gsplat": None if gsplat is None else gsplat.description,
        "losses": losses,
        "disagreement": disagreement(losses),
        "steps": _summaries(seconds, window),
    }


def _contestants(
    ours: Trainer,
    frames: list[FrameTensors],
    folder: Path,
    checkpoint: dict[str, Any],
    gsplat: Gsplat | None,
    with_plain: bool,
) -> dict[str, Contestant]:
    """Everyone, warm."""
    config, capture, device = ours.config, ours.capture, ours.device
    contestants = {OURS: _trained_by(ours)}
    if with_plain:
        plain = replace(config, graph=False, compile=False)
        contestants[PLAIN] = _trained_by(steady_trainer(plain, capture, folder / "plain", checkpoint=checkpoint))
    gaussians = ours.model.gaussians("shared")
    if gsplat is not None:
        model = SceneModel.from_checkpoint(checkpoint, device)
        training = GsplatTraining(model, config, ours.sh_degree, gsplat)
        contestants[TWO_CALLS] = Contestant(
            _in_windows(training.step, frames, device),
            lambda frame: {name: loss.item() for name, loss in training.losses(frame).items()},
        )
        contestants[GSPLAT_RGB] = Contestant(
            _in_windows(_gsplat_rgb_step(gaussians, gsplat, ours.sh_degree), frames, device)
        )
    contestants[OURS_RGB] = _trained_by(
        steady_trainer(_rgb_config(config), capture, folder / "rgb", gaussians=_plain_copy(gaussians))
    )
    return contestants


def _trained_by(trainer: Trainer) -> Contestant:
    """A trainer's own steps, logging and all."""
    warm_up(trainer)

    def losses(frame: FrameTensors) -> dict[str, float]:
        kind = StepKind(trainer.sh_degree, densifying=False)
        done = trainer.device_step.gradients(frame, kind, fixed_capacity=False)
        trainer.state.clear_gradients()
        return {name: loss.item() for name, loss in done.losses.items()}

    def plain_losses(frame: FrameTensors) -> dict[str, float]:
        fast, trainer.device_step.decoding = trainer.device_step.decoding, nullcontext
        try:
            return losses(frame)
        finally:
            trainer.device_step.decoding = fast

    return Contestant(lambda count: run_steps(trainer, count), losses, plain_losses)


def _in_windows(
    step: Callable[[FrameTensors], object], frames: list[FrameTensors], device: torch.device
) -> Callable[[int], float]:
    order = cycle(frames)

    def run(count: int) -> float:
        wait(device)
        started = perf_counter()
        for _ in range(count):
            step(next(order))
        wait(device)
        return perf_counter() - started

    return run


def _rgb_config(config: TrainConfig) -> TrainConfig:
    """The 3dgs preset on RGB images alone, run like ``config``."""
    preset = load_config("3dgs")
    rgb = replace(
        preset,
        model=replace(preset.model, thermal=False),
        sh_degree=config.sh_degree,
        device=config.device,
        graph=config.graph,
        compile=config.compile,
        log_every=config.log_every,
    )
    return steady_config(rgb, densifying=False)


def _plain_copy(gaussians: Gaussians) -> Gaussians:
    """Without what only the thermal spectrum has."""
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    return Gaussians({name: getattr(gaussians, name) for name in names})


def _gsplat_rgb_step(gaussians: Gaussians, gsplat: Gsplat, sh_degree: int) -> Callable[[FrameTensors], None]:
    """gsplat's RGB training as in train_gsplat_peer.py, without its density control; the rates are 0."""
    from train_gsplat_peer import adam_optimizers, image_loss, rendered

    stored = {"scales": "log_scales", "opacities": "logit_opacities"}
    names = ("means", "scales", "quats", "opacities", "sh0", "shN")
    values = {name: getattr(gaussians, stored.get(name, name)).detach().clone() for name in names}
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in values.items()})
    optimizers = adam_optimizers(params, scene_scale=0.0)
    for optimizer in optimizers.values():
        optimizer.param_groups[0]["lr"] = 0.0

    def step(frame: FrameTensors) -> None:
        view = frame.rgb
        image, _, _ = rendered(gsplat.rasterization, params, view, sh_degree, **gsplat.options)
        image_loss(image[0], view.image).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    return step


def _compared_losses(contestants: dict[str, Contestant], frames: list[FrameTensors]) -> dict[str, dict[str, float]]:
    """Each loss term ours and gsplat's, means over frames, and the largest relative difference of a frame."""
    if TWO_CALLS not in contestants:
        return {}
    ours = contestants[OURS]
    timed, plain, theirs = (
        [made(frame) for frame in frames]
        for made in (ours.losses, ours.plain_losses, contestants[TWO_CALLS].losses)
        if made is not None
    )

    def apart(some: list[dict[str, float]], name: str) -> float:
        pairs = zip(some, theirs, strict=True)
        return float(np.max([abs(one[name] - other[name]) / abs(other[name]) for one, other in pairs]))

    return {
        name: {
            "thermosplat": float(np.mean([losses[name] for losses in timed])),
            "gsplat": float(np.mean([losses[name] for losses in theirs])),
            "relative_difference": apart(plain, name),
            "timed_relative_difference": apart(timed, name),
        }
        for name in timed[0]
    }


def disagreement(losses: dict[str, dict[str, float]]) -> str | None:
    """What of the losses differs by more than the tolerance, if anything.

    Args:
        losses: From :func:`compare_steps`.
    """
    tolerances = {"relative_difference": LOSS_TOLERANCE, "timed_relative_difference": TIMED_TOLERANCE}
    apart = [
        f"{name} {terms[key]:.1e}"
        for name, terms in losses.items()
        for key, tolerance in tolerances.items()
        if not terms[key] <= tolerance
    ]
    return f"losses differ: {', '.join(apart)}" if apart else None


def _summaries(seconds: dict[str, list[float]], window: int) -> dict[str, dict[str, float]]:
    medians = {name: float(np.median(times)) / window for name, times in seconds.items()}
    return {
        name: {
            "milliseconds": 1e3 * medians[name],
            "fastest_ms": 1e3 * min(times) / window,
            "slowest_ms": 1e3 * max(times) / window,
            "steps_per_second": 1.0 / medians[name],
            "times_ours": medians[name] / medians[OURS],
        }
        for name, times in seconds.items()
    }
