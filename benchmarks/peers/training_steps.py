"""Steps per second of our training step beside gsplat's, on the same Gaussians, in interleaved windows."""

import math
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from measuring.timing import summary, wait
from peers.gsplat_rgbt import gsplat_rasterization
from peers.gsplat_user_step import GsplatUserStep
from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config
from thermosplat.datasets.capture import Capture
from thermosplat.losses.image_terms import image_loss
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.scene.gaussians import Gaussians
from thermosplat.training.step_kind import StepKind
from thermosplat.training.trainer import Trainer
from training.frozen_training import Frames, frozen_trainer, run_steps, warm_up

RGB = "rgb"
"""The spectrum that gsplat is timed on alone."""

OURS, OURS_BY_LINE = "thermosplat", "thermosplat --no-graph"
TWICE, GSPLAT_RGB = "the same on gsplat's rasterizer, called twice", "gsplat, RGB alone"
USER = "the same in eager PyTorch, on gsplat's rasterizer called twice"
OURS_3DGS, OURS_RGB = "thermosplat --config 3dgs", "thermosplat --config 3dgs, RGB alone"
AGREEMENT = 1e-3
"""Largest relative difference of a loss on one view between the two rasterizers."""

USER_AGREEMENT = 2e-2
"""The same where one side decodes in float32 and the other rounds the inputs of its matrix products to 10 bits, which
smoothness, a sum of small differences, feels most."""

Steps = Callable[[int], float]
"""Does so many steps; seconds until the device has done them."""


def compare_steps(
    config: TrainConfig,
    capture: Capture,
    checkpoint: Checkpoint,
    frames: Frames,
    device: torch.device,
    window: int,
    rounds: int,
) -> dict[str, Any]:
    """Times every peer that can run here.

    Args:
        config: Of the run that ``checkpoint`` is the state of.
        capture: What it was trained on.
        checkpoint: From ``warm_training``.
        frames: As in ``quiet_trainer``.
        device: Where to train.
        window: Steps in a measurement.
        rounds: Measurements of each, in turns.

    Returns:
        ``num_gaussians``; ``peers``: for each name median and spread of the milliseconds per step and ``steps_per_s``;
        ``agreement``; ``left_out``: why others are not there.
    """
    result: dict[str, Any] = {"window": window, "rounds": rounds, "left_out": {}}
    peers: dict[str, Steps] = {}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:

        def trainer(name: str, config: TrainConfig, **start: Any) -> Trainer:
            made = frozen_trainer(config, capture, Path(folder) / name, frames=frames, **start)
            stack.callback(made.logger.close)
            return made

        ours = trainer("ours", config, checkpoint=checkpoint)
        result["num_gaussians"] = ours.model.num_gaussians
        warm_up(ours)
        peers[OURS] = partial(run_steps, ours)
        if device.type != "cuda":
            result["left_out"]["gsplat"] = "its kernels need CUDA; on the CPU only our own step is timed"
        else:
            source = next(iter(ours.state.gaussian_sets.values()))
            by_line = trainer("by_line", replace(config, graph=False), checkpoint=checkpoint)
            warm_up(by_line)
            peers[OURS_BY_LINE] = partial(run_steps, by_line)
            try:
                _add_gsplat(peers, result, ours, by_line, source, capture)
            except Exception as error:  # not installed, not compiled here, or out of memory: the others are timed
                traceback.print_exc()
                result["left_out"]["gsplat"] = f"{type(error).__name__}: {error}".splitlines()[0]
            others = tuple(name for name in config.spectra if name != RGB)
            for name, without in ((OURS_3DGS, config.without), (OURS_RGB, others)):
                plain = _plain_config(config, without)
                separate = trainer(f"3dgs_{len(plain.modelled)}", plain, gaussians=source)
                warm_up(separate)
                peers[name] = partial(run_steps, separate)
        times: dict[str, list[float]] = {name: [] for name in peers}
        for _ in range(rounds):
            for name, steps in peers.items():
                times[name].append(1e3 * steps(window) / window)
    result["peers"] = {
        name: summary(found) | {"steps_per_s": 1e3 / summary(found)["median_ms"]} for name, found in times.items()
    }
    for found in result["peers"].values():
        found["times_ours"] = found["median_ms"] / result["peers"][OURS]["median_ms"]
    return result


def _plain_config(config: TrainConfig, without: tuple[str, ...]) -> TrainConfig:
    """The preset 3dgs with what of ``config`` is not the method, on all its spectra but these."""
    preset = load_config("3dgs")
    return replace(
        preset,
        device=config.device,
        sh_degree=config.sh_degree,
        seed=config.seed,
        graph=config.graph,
        compile=config.compile,
        spectra={name: preset.spectra.get(name, spectrum) for name, spectrum in config.spectra.items()},
        without=without,
    )


def _add_gsplat(
    peers: dict[str, Steps],
    result: dict[str, Any],
    ours: Trainer,
    by_line: Trainer,
    source: Gaussians,
    capture: Capture,
) -> None:
    """Adds gsplat's steps; those of our model only if their losses agree with ours.

    Args:
        peers: Gets them.
        result: Gets ``agreement`` and ``user_agreement``, and the reason in ``left_out`` if one is not close enough.
        ours: Warm.
        by_line: The same without a graph.
        source: The Gaussians of gsplat's own step.
        capture: Says how large the scene is.

    Raises:
        ImportError: gsplat is not there.
    """
    import gsplat

    def swapped() -> Any:
        return gsplat_rasterization(gsplat.rasterization, gsplat.spherical_harmonics)

    result["agreement"] = agreement(ours, by_line, swapped)
    if result["agreement"]["largest"] <= AGREEMENT:
        with swapped():
            warm_up(by_line)

        def run_twice(count: int) -> float:
            with swapped():
                return run_steps(by_line, count)

        peers[TWICE] = run_twice
    else:
        result["left_out"][TWICE] = f"its losses differ by {result['agreement']['largest']:.1e} from ours"
    user = GsplatUserStep(ours, swapped)
    apart = _apart(_losses(ours)[0], user.loss_values())
    result["user_agreement"] = apart
    if max(apart.values()) <= USER_AGREEMENT:
        user.run(3)
        peers[USER] = user.run
    else:
        result["left_out"][USER] = f"its losses differ by {max(apart.values()):.1e} from ours"
    alone = _GsplatRgb(source, capture, ours)
    alone.run(3)
    peers[GSPLAT_RGB] = alone.run


def agreement(ours: Trainer, other: Trainer, swapped: Callable[[], Any] = nullcontext) -> dict[str, Any]:
    """How far losses and gradients of the first frame are apart between two trainers of the same Gaussians.

    Args:
        ours: The first.
        other: The second.
        swapped: Opened around the second.

    Returns:
        ``losses``: relative differences by term, ``largest`` of them, and of ``gradients`` that of each parameter's
        norm of the difference to the norm.
    """
    losses, gradients = _losses(ours)
    with swapped():
        other_losses, other_gradients = _losses(other)
    apart = _apart(losses, other_losses)
    slopes = {
        name: float((other_gradients[name] - value).norm() / value.norm().clamp(min=1e-30))
        for name, value in gradients.items()
    }
    return {"losses": apart, "largest": max(apart.values()), "gradients": slopes}


def _apart(losses: dict[str, float], others: dict[str, float]) -> dict[str, float]:
    """Relative differences by term; infinite where one is not a number."""
    apart = {name: abs(others[name] - value) / abs(value) for name, value in losses.items()}
    return {name: value if math.isfinite(value) else math.inf for name, value in apart.items()}


def _losses(trainer: Trainer) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Loss terms of the first frame, and gradients by parameter; the state stays as it is."""
    kind = StepKind(trainer.config.sh_degree, densifying=False)
    done = trainer.device_step.gradients([trainer.frames[0]], kind, trainer.steps.plan(), fixed_capacity=False)
    gradients = {name: p.grad.clone() for name, p in trainer.model.named_parameters() if p.grad is not None}
    trainer.state.clear_gradients()
    return {name: float(loss.detach()) for name, loss in done.losses.items()}, gradients


class _GsplatRgb:
    """gsplat's RGB-only step of train_gsplat_peer.py at our Gaussians; densification and rates off, as in ours.

    The image loss is our fused kernel, which stands in for the fused one that gsplat's trainer takes from elsewhere.
    """

    def __init__(self, source: Gaussians, capture: Capture, ours: Trainer) -> None:
        from train_gsplat_peer import published_optimizers, render

        self.render, self.device, self.degree = render, ours.device, ours.config.sh_degree
        values = {
            "means": source.means,
            "scales": source.log_scales,
            "quats": source.quats,
            "opacities": source.logit_opacities,
            "sh0": source.sh0,
            "shN": source.shN,
        }
        copies = {name: torch.nn.Parameter(value.detach().clone()) for name, value in values.items()}
        self.params = torch.nn.ParameterDict(copies)
        self.optimizers = published_optimizers(self.params, capture.scene_extent)
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["lr"] = 0.0
        views = [frame.views[RGB] for frame in ours.frames if RGB in frame.views]
        self.pairs = [(view, view.image) for view in views if view.image is not None]

    def run(self, count: int) -> float:
        """Does so many steps; seconds until the device has done them."""
        wait(self.device)
        started = time.perf_counter()
        for step in range(count):
            view, target = self.pairs[step % len(self.pairs)]
            image, _, _ = self.render(self.params, view, self.degree)
            image_loss(image[0], target, 0.2).backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
        wait(self.device)
        return time.perf_counter() - started
