"""A training step at a size: milliseconds, where they go beside their floors, and the memory it takes."""

import gc
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from measuring.device_peaks import DevicePeaks
from measuring.gpu_memory import peak_memory
from measuring.timing import summary
from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.training.trainer import Trainer
from training.frozen_training import Frames, frozen_trainer, run_steps, synthetic_capture, synthetic_gaussians, warm_up
from training.parts_alone import parts_alone
from training.step_floors import step_floors
from training.step_parts import part_times, profiled_steps

KERNELS = 40
"""Kernels that a row lists by name."""


def profiled_row(trainer: Trainer, name: str, peaks: DevicePeaks, window: int, rounds: int) -> dict[str, Any]:
    """Time of a step in windows without the profiler, then its parts with it.

    Args:
        trainer: Frozen and warm.
        name: What is trained.
        peaks: Measured.
        window: Steps in a measurement, and in the profile.
        rounds: Measurements.
    """
    milliseconds = [1e3 * run_steps(trainer, window) / window for _ in range(rounds)]
    kernels = profiled_steps(trainer, window)
    floors, work = step_floors(trainer, peaks)
    view = next(iter(trainer.frames[0].views.values()))
    parts: dict[str, dict[str, Any]] = {part: {"ms": ms} for part, ms in part_times(kernels).items()}
    for part, floor in floors.items():
        parts.setdefault(part, {"ms": None}).update(floor)
        if parts[part]["ms"] is not None:
            parts[part]["times_floor"] = parts[part]["ms"] / floor["floor_ms"]
    alone, alone_error = _alone(trainer, peaks, rounds)
    times = summary(milliseconds)
    kernels_ms = sum(kernel["microseconds"] for kernel in kernels) / 1e3
    idle_ms = max(0.0, times["median_ms"] - kernels_ms) if trainer.device.type == "cuda" else None
    return {
        "name": name,
        "size": f"{view.width}x{view.height}",
        "pixels": view.width * view.height,
        "num_gaussians": trainer.model.num_gaussians,
        **times,
        "kernels_ms": kernels_ms,
        "host_gap_ms": idle_ms,
        "floor_ms": sum(floor["floor_ms"] for floor in floors.values()),
        "parts": parts,
        "alone": alone,
        **alone_error,
        **work,
        "kernels": kernels[:KERNELS],
    }


def _alone(trainer: Trainer, peaks: DevicePeaks, repeats: int) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """The parts that are timed alone; where that fails none and why, since the rest of the row counts more."""
    try:
        return parts_alone(trainer, peaks, repeats), {}
    except Exception as error:
        traceback.print_exc()
        return {}, {"alone_error": f"{type(error).__name__}: {error}".splitlines()[0]}


def capture_rows(
    config: TrainConfig,
    capture: Capture,
    checkpoint: Checkpoint,
    frames: Frames,
    plain: bool,
    row: Callable[..., dict[str, Any]],
) -> list[dict[str, Any]]:
    """The step on a capture, from ``warm_training``'s state; with ``plain`` also launched line by line.

    Args:
        config: The whole configuration.
        capture: The capture.
        checkpoint: Where to start.
        frames: As in ``quiet_trainer``.
        plain: Also without graph and compilation.
        row: ``profiled_row`` of a trainer and a name.
    """
    kinds = {capture.name: config}
    if plain:
        kinds[f"{capture.name}, --no-graph --no-compile"] = replace(config, graph=False, compile=False)
    rows = []
    for name, kind in kinds.items():
        with tempfile.TemporaryDirectory() as folder:
            trainer = frozen_trainer(kind, capture, Path(folder) / "run", checkpoint=checkpoint, frames=frames)
            warm_up(trainer)
            rows.append(row(trainer, name))
    return rows


def synthetic_row(
    config: TrainConfig, count: int, size: tuple[int, int], row: Callable[..., dict[str, Any]] | None
) -> dict[str, Any]:
    """The step on random Gaussians, and the memory that model, optimizers, frames and steps take together.

    Args:
        config: The whole configuration.
        count: Gaussians.
        size: Width and height of all images [px].
        row: ``profiled_row`` of a trainer and a name; None: memory alone.
    """
    capture = synthetic_capture(*size, config.modelled)
    gaussians = synthetic_gaussians(count, config.model.feature_dim, config.sh_degree, config.modelled)
    made: list[Trainer] = []
    with tempfile.TemporaryDirectory() as folder:

        def train() -> None:
            made.append(frozen_trainer(config, capture, Path(folder) / "run", gaussians=gaussians))
            warm_up(made[0])
            run_steps(made[0], 3)

        device = torch.device("cuda") if config.device != "cpu" and torch.cuda.is_available() else torch.device("cpu")
        _release()
        reserved = torch.cuda.memory_reserved(device) if device.type == "cuda" else 0
        memory = peak_memory(train, device)
        if not made:  # on the CPU nothing is measured, nor called
            train()
        found: dict[str, Any] = {"name": f"random {count:,}", "size": f"{size[0]}x{size[1]}"}
        found |= {"num_gaussians": count, "pixels": size[0] * size[1], "memory_mib": memory}
        if device.type == "cuda":
            found["reserved_mib"] = round((torch.cuda.memory_reserved(device) - reserved) / 2**20, 1)
        if row is not None:
            found |= row(made[0], found["name"])
        made.clear()
    _release()
    return found


def _release() -> None:
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def memory_fit(rows: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Bytes a Gaussian and a pixel of one image by least squares, of peak memory = a N + b W·H + c.

    Args:
        rows: With ``memory_mib``, ``num_gaussians`` and ``pixels``.

    Returns:
        ``bytes_a_gaussian``, ``bytes_a_pixel``, ``bytes_besides``, and ``worst_mib``, the largest residual; None where
        the sizes that were measured leave one of the three unknown.
    """
    measured = [row for row in rows if row.get("memory_mib") is not None]
    matrix = np.array([[row["num_gaussians"], row["pixels"], 1.0] for row in measured])
    if len(measured) < 3 or np.linalg.matrix_rank(matrix / matrix.max(0)) < 3:
        return None
    values = np.array([row["memory_mib"] * 2**20 for row in measured])
    scale = matrix.max(0)
    solution = np.linalg.lstsq(matrix / scale, values, rcond=None)[0] / scale
    return {
        "bytes_a_gaussian": float(solution[0]),
        "bytes_a_pixel": float(solution[1]),
        "bytes_besides": float(solution[2]),
        "worst_mib": float(np.abs(matrix @ solution - values).max() / 2**20),
        "sizes": len(measured),
    }
