"""Trainers whose work stays the same from step to step, so that steps can be timed, compared and profiled.

Nothing is added or removed, all degrees of the spherical harmonics are in use, and the Gaussians' and decoders'
learning rates are 0: a step computes and writes everything a step does, and the next one finds the same Gaussians.
"""

import copy
import functools
import io
import time
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from measuring.timing import wait
from scenes.benchmark_scenes import synthetic_scene
from thermosplat.config import OptimizerConfig, TrainConfig
from thermosplat.datasets.cameras import Camera
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.devices import choose_device
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.gaussians import Gaussians, offsets_name, own_logits_name, sh_names
from thermosplat.spectra import DEFAULT_SPECTRA, ColorSpace, SpectrumConfig
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.training.density.gaussian_ops import become_copy
from thermosplat.training.session.run_logger import RunLogger
from thermosplat.training.trainer import Trainer

Frames = dict[int, FrameTensors]
"""Training frames on the device, by number."""

COLOR_SPACES: dict[str, ColorSpace] = {"photograph": "photograph", "auto": "color", "color": "color", "raw": "scalar"}
"""What random images of a spectrum are, by its source."""

ENDLESS = 100_000_000
"""Steps of a run that is never finished."""


def quiet_trainer(
    config: TrainConfig,
    capture: Capture,
    folder: Path,
    checkpoint: Checkpoint | None = None,
    frames: Frames | None = None,
) -> Trainer:
    """A trainer that prints nothing.

    Args:
        config: The whole configuration.
        capture: Frames to learn from.
        folder: Where metrics.jsonl goes; it must not hold a run.
        checkpoint: ``TrainingState.checkpoint``; None starts from the capture's points.
        frames: Frames of the capture that others have put on the device already; the trainer adds those it needs.
    """
    run = RunDirectory.create(folder)
    logger = RunLogger(
        run,
        max_steps=config.max_steps,
        log_every=config.log_every,
        device=choose_device(config.device),
        tensorboard=False,
        console=Console(file=io.StringIO()),
    )
    trainer = Trainer(config, capture, run, logger, checkpoint)
    if frames is not None and len(trainer.frames.frames) == len(capture.train):  # else they have other numbers
        trainer.frames._cache = frames
    return trainer


def frozen(config: TrainConfig) -> TrainConfig:
    """A configuration under which steps repeat the same work."""
    rates = {field.name: 0.0 for field in fields(OptimizerConfig) if field.name.endswith("_lr")}
    always = {"train_from": 0.0, "train_until": 1.0, "start": "points"}
    return replace(
        config,
        max_steps=ENDLESS,
        eval_steps=(),
        save_steps=(),
        spectra={name: replace(spectrum, **always) for name, spectrum in config.spectra.items()},
        sh_degree_interval=1,
        budget="fixed",
        optimizer=replace(config.optimizer, **rates),
        densification=replace(config.densification, stop_step=0),
    )


def frozen_trainer(
    config: TrainConfig,
    capture: Capture,
    folder: Path,
    *,
    gaussians: Gaussians | None = None,
    checkpoint: Checkpoint | None = None,
    frames: Frames | None = None,
) -> Trainer:
    """A trainer under ``frozen(config)``.

    Args:
        config: The whole configuration.
        capture: Frames to learn from.
        folder: Where metrics.jsonl goes; it must not hold a run.
        gaussians: What every set of Gaussians becomes a copy of; None: the checkpoint's, or the capture's points.
        checkpoint: ``TrainingState.checkpoint``; it is copied.
        frames: As in ``quiet_trainer``.
    """
    trainer = quiet_trainer(frozen(config), capture, folder, copy.deepcopy(checkpoint), frames)
    if gaussians is not None:
        source = copy.deepcopy(gaussians).to(trainer.device)  # the caller's stays where it is
        for name, owned in trainer.state.gaussian_sets.items():
            become_copy(owned, trainer.state.optimizers[name], source)
            trainer.state.strategies[name].forget(len(owned))
    trainer.state.step = max(trainer.state.step, config.sh_degree + 1)  # all degrees from the next step on
    return trainer


def run_steps(trainer: Trainer, count: int, *, waiting: bool = True) -> float:
    """Does so many steps; seconds until the device has done them, or without ``waiting`` until they are launched."""
    if waiting:
        wait(trainer.device)
    started = time.perf_counter()
    for _ in range(count):
        trainer.train_step()
    if waiting:
        wait(trainer.device)
    return time.perf_counter() - started


def warm_up(trainer: Trainer) -> None:
    """Puts all frames on the device, compiles kernels, and on CUDA lets the step be captured."""
    for index in range(len(trainer.frames)):
        trainer.frames[index]
    run_steps(trainer, len(trainer.frames) + 5 if trainer.steps.recordings is not None else 3)


def synthetic_capture(width: int, height: int, spectra: Mapping[str, SpectrumConfig] = DEFAULT_SPECTRA) -> Capture:
    """Two frames of noise in all spectra from the camera of ``synthetic_scene``, of one pose and size [px]."""
    return _noise(width, height, tuple((name, COLOR_SPACES[spectrum.source]) for name, spectrum in spectra.items()))


@functools.lru_cache(maxsize=1)
def _noise(width: int, height: int, spectra: tuple[tuple[str, ColorSpace], ...]) -> Capture:
    K = synthetic_scene(4).intrinsics(width, height).tolist()
    camera = Camera(K[0][0], K[1][1], K[0][2], K[1][2], width, height)
    random = np.random.default_rng(0)

    def view(spectrum: str, kind: ColorSpace, name: str) -> View:
        image = random.integers(0, 256, (height, width, 1 if kind == "scalar" else 3), dtype=np.uint8)
        return View(spectrum, name, Path(f"{name}.png"), camera, np.eye(4), image)

    frames = tuple(
        Frame(name, {spectrum: view(spectrum, kind, name) for spectrum, kind in spectra})
        for name in ("first", "second")
    )
    scales = {spectrum: PixelScale(kind) for spectrum, kind in spectra}
    points = random.uniform(-1, 1, (100, 3)).astype(np.float32)
    colors = random.integers(0, 256, (100, 3), dtype=np.uint8)
    return Capture("synthetic", Path("synthetic"), "noise", frames, (), points, colors, scales)


def synthetic_gaussians(
    count: int, feature_dim: int, sh_degree: int, spectra: Iterable[str] = DEFAULT_SPECTRA
) -> Gaussians:
    """The Gaussians of ``synthetic_scene`` as a set with every kind of parameter that models of these spectra have.

    Opacities of spectra behind the first are those of the scene's second one.
    """
    scene = synthetic_scene(count)
    logits = torch.logit(scene.opacities, eps=1e-6)
    thermal_logits = torch.logit(scene.thermal_opacities, eps=1e-6)
    higher = scene.sh[:, 1 : (sh_degree + 1) ** 2]
    parameters = {
        "means": scene.means,
        "quats": scene.quats,
        "log_scales": scene.scales.log(),
        "logit_opacities": logits,
        "features": scene.features(max(feature_dim, 1)),
        "sh0": scene.sh[:, :1],
        "shN": higher,
    }
    for spectrum in list(spectra)[1:]:
        first, rest = sh_names(spectrum)
        parameters |= {own_logits_name(spectrum): thermal_logits, offsets_name(spectrum): thermal_logits - logits}
        parameters |= {first: scene.sh[:, :1], rest: higher}
    return Gaussians(parameters)
