"""Poses of held-out frames, found on the frozen scene.

Where training has moved the cameras, a held-out frame still stands where the capture put it, wrong by as much as the
others were. So each of them is moved as a whole until its images fit best, as the training frames were, and nothing
else changes. What is measured then is the scene, not the capture's poses. NeRF-- (Wang et al. 2021) and BARF (Lin et
al. 2021) evaluate alike.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from thermosplat.config import OF_FRAMES, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import FrameTensors, frame_tensors
from thermosplat.datasets.read_ahead import read_ahead
from thermosplat.evaluation.held_out import Lpips, evaluate
from thermosplat.losses.image_terms import compare_frame
from thermosplat.refinement.camera_corrections import frame_center, frame_moves, pose_basis
from thermosplat.refinement.camera_motion import moved_frame
from thermosplat.refinement.corrected_capture import with_moved_frames
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import label
from thermosplat.thermography.scene_temperatures import SceneTemperatures

STEPS = 100
"""Updates per frame. Open choice."""
RATES = (1.5e-3, 1.5e-5)
"""Adam's learning rate at the first and at the last update [image widths]. Open choice: the updates sum up to 3% of the
width, more than the pose of a frame that training could use is wrong by."""


@dataclass(frozen=True)
class Judged:
    """A model against its held-out views."""

    metrics: dict[str, Any]
    """As ``evaluate`` returns them. Where poses are refined, "test_poses" says so, and "unrefined" holds the numbers by
    spectrum with the poses of the capture."""
    capture: Capture
    """The capture with the cameras that were judged by."""


def evaluate_refined(
    model: SceneModel,
    capture: Capture,
    config: TrainConfig,
    *,
    sh_degree: int,
    lpips: Lpips | None = None,
    strips_dir: Path | None = None,
    csv_path: Path | None = None,
    temperatures: SceneTemperatures | None = None,
) -> Judged:
    """Judge a model by its held-out views, whose poses are found first if training refined those of its own.

    The other arguments are those of ``evaluate``.

    Args:
        capture: The capture with corrected cameras (``corrected_capture``).
        config: The run's; what it refines, and the weights of the image losses.
    """
    how: dict[str, Any] = {"sh_degree": sh_degree, "lpips": lpips, "temperatures": temperatures}
    if OF_FRAMES.isdisjoint(config.refine):
        return Judged(evaluate(model, capture, **how, strips_dir=strips_dir, csv_path=csv_path), capture)
    unrefined = evaluate(model, capture, **how)
    motions = held_out_motions(model, capture, config, sh_degree=sh_degree)
    capture = with_moved_frames(capture, motions)
    metrics = evaluate(model, capture, **how, strips_dir=strips_dir, csv_path=csv_path)
    of_spectra = {name: unrefined[name] for name in model.spectra}
    return Judged({**metrics, "test_poses": "refined on the finished scene", "unrefined": of_spectra}, capture)


def unrefined_sentences(metrics: Mapping[str, Any]) -> list[str]:
    """What to tell people of the poses that held-out views were judged with; nothing where they are the capture's.

    Args:
        metrics: Of ``Judged``.
    """
    if "unrefined" not in metrics:
        return []
    numbers = {name: numbers["psnr"] for name, numbers in metrics["unrefined"].items() if numbers is not None}
    listed = ", ".join(f"{label(name)} {value:.2f} dB" for name, value in numbers.items() if value is not None)
    return [f"Poses of held-out views were {metrics['test_poses']}; with those of the capture: {listed}."]


@torch.enable_grad()
def held_out_motions(
    model: SceneModel,
    capture: Capture,
    config: TrainConfig,
    *,
    sh_degree: int,
) -> dict[str, Tensor]:
    """How each held-out frame has to move to fit the scene.

    Args:
        model: The scene; it stays as it is.
        capture: The capture, whose ``test`` frames are looked at.

    Returns:
        (r, t) by the frame's name [rad, scene extents], shape [6], the best of all updates.
    """
    config = _image_losses_alone(config)
    found: dict[str, Tensor] = {}
    with _frozen(model):
        for frame in read_ahead(capture.test):
            tensors = frame_tensors(frame, capture.scales, model.device).only(tuple(model.spectra))
            if tensors.views and frame_moves(config.refine, frame, tuple(model.spectra)):
                center = frame_center(frame).float().to(model.device)
                basis = pose_basis(frame, capture.points, capture.scene_extent).to(model.device)
                found[frame.name] = _best_motion(model, tensors, center, basis, config, sh_degree, capture.scene_extent)
    return found


def _best_motion(
    model: SceneModel,
    frame: FrameTensors,
    center: Tensor,
    basis: Tensor,
    config: TrainConfig,
    sh_degree: int,
    scene_extent: float,
) -> Tensor:
    """The motion with the least loss of all that were tried, no motion among them."""
    learnt = center.new_zeros(6, requires_grad=True)
    width = next(iter(frame.views.values())).width
    first, last = (rate * width for rate in RATES)
    optimizer = torch.optim.Adam([learnt], lr=first)
    least, best = math.inf, center.new_zeros(6)
    for step in range(STEPS + 1):
        motion = basis @ learnt
        views = moved_frame(frame.views, motion, center, scene_extent)
        rendered = model.render(views, sh_degree=sh_degree, shared_cameras=frame.shared_cameras)
        losses = compare_frame(rendered, frame, config).losses
        if not losses:
            return best
        loss = torch.stack(list(losses.values())).sum()
        if (value := float(loss.detach())) < least:
            least, best = value, motion.detach().clone()
        if step < STEPS:
            optimizer.zero_grad()
            loss.backward()
            optimizer.param_groups[0]["lr"] = first * (last / first) ** (step / (STEPS - 1))
            optimizer.step()
    return best


def _image_losses_alone(config: TrainConfig) -> TrainConfig:
    """The configuration without losses on latent channels and without smoothness: what the images say of the pose."""
    spectra = {name: replace(spectrum, smoothness=0.0) for name, spectrum in config.spectra.items()}
    return replace(config, spectra=spectra, loss=replace(config.loss, features=0.0))


@contextmanager
def _frozen(model: SceneModel) -> Iterator[None]:
    """While this is open no gradient reaches the model."""
    learnt = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in learnt:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learnt:
            parameter.requires_grad_(True)
