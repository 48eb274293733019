"""Making one cell: train it, or go on with it, measure it, and say so in its cell.json."""

import csv
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config
from thermosplat.datasets import capture_of
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import FrameTensors, without_pixels
from thermosplat.method_matrix.cell_result import CellResult, read_regions, write_cell
from thermosplat.method_matrix.cells import Cell, difference, settings
from thermosplat.method_matrix.panels import write_panels
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.model import SceneModel
from thermosplat.training.trainer import Trainer


def make_cell(cell: Cell, config: TrainConfig, folder: Path, *, keep_checkpoint: bool) -> CellResult:
    """Train and measure a cell.

    Args:
        folder: Its run folder; an interrupted run in it with the same settings is gone on with.
        keep_checkpoint: Keep the last checkpoint; the earlier ones go in any case.

    Returns:
        What was also written to cell.json.

    Raises:
        TrainingInterrupted: After Ctrl-C; a checkpoint was saved.
        UserError: The capture or the configuration cannot be used, or another process makes this cell.
    """
    with RunDirectory(folder).locked():
        return _made(cell, config, folder, keep_checkpoint)


def _made(cell: Cell, config: TrainConfig, folder: Path, keep_checkpoint: bool) -> CellResult:
    trainer = _trainer(config, folder)
    if trainer.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(trainer.device)
    metrics = trainer.train()
    on_cuda = trainer.device.type == "cuda"
    peak = torch.cuda.max_memory_allocated(trainer.device) if on_cuda else None
    model, sh_degree = trainer.model.eval(), trainer.sh_degree
    write_panels(folder, model, trainer.corrected_capture(), sh_degree=sh_degree)
    result = CellResult(
        scene=cell.scene,
        method=cell.method,
        seed=cell.seed,
        steps=metrics["steps"],
        spectra={name: metrics[name] for name in metrics["spectra"]},
        num_gaussians=metrics["num_gaussians"],
        model_bytes=metrics["model_bytes"],
        train_minutes=metrics["train_seconds"] / 60.0,
        peak_memory_bytes=peak,
        frames_per_second=frames_per_second(model, trainer.corrected_capture(), sh_degree=sh_degree),
        device=metrics["device"],
        lpips_net=metrics["lpips_net"],
        settings=settings(config),
        per_view=_per_view(trainer.run.stats / "per_view.csv"),
        regions=read_regions(folder, metrics["steps"]),
    )
    write_cell(folder, result)  # from here on the cell is finished
    files = trainer.run.checkpoints()
    for file in files[:-1] if keep_checkpoint else files:
        file.unlink()
    return result


def _trainer(config: TrainConfig, folder: Path) -> Trainer:
    capture = capture_of(config)
    config, run = replace(config, result_dir=str(folder), overwrite=False), RunDirectory(folder)
    if run.latest_checkpoint() is not None and run.config_yaml.is_file():
        before = load_config(run.config_yaml)
        if not difference(settings(before), settings(config)):
            return Trainer.resume(config, capture, run)
    trainer = Trainer(config, capture, run)
    RunDirectory.create(folder, overwrite=True)
    return trainer


def _per_view(path: Path) -> list[dict[str, Any]]:
    """The rows of per_view.csv with numbers as numbers, empty cells as None."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    texts = ("frame", "spectrum")
    return [{key: text if key in texts else float(text) if text else None for key, text in row.items()} for row in rows]


LEAST_SECONDS = 1.0
"""A GPU is timed at least this long [s]."""


@torch.no_grad()
def frames_per_second(model: SceneModel, capture: Capture, *, sh_degree: int) -> float:
    """Held-out frames rendered a second, each with all modelled spectra, at the size of its images.

    Every frame is rendered once before the clock starts. Nothing is copied back from the device.

    Args:
        capture: Its capture; ``capture.test`` is rendered.
    """
    device = model.device
    frames = [
        FrameTensors(f.name, {name: without_pixels(v, device) for name, v in f.views.items()}, f.shared_cameras)
        for f in capture.test
    ]

    def render_all() -> None:
        for frame in frames:
            model.render(frame.views, sh_degree=sh_degree, shared_cameras=frame.shared_cameras)
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    render_all()
    started, rounds, elapsed = time.perf_counter(), 0, 0.0
    while rounds == 0 or (device.type == "cuda" and elapsed < LEAST_SECONDS):
        render_all()
        rounds += 1
        elapsed = time.perf_counter() - started
    return rounds * len(frames) / elapsed
