"""One case of ``bench_training.py --parts step``: where a step's time and memory go, and how far from the floor."""

import gc
import traceback
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from device_peaks import DevicePeaks
from random_training_scene import random_capture, random_gaussians
from steady_training import run_steps, steady_config, steady_trainer, warm_up
from step_kernels import milliseconds_by_part, step_kernels
from step_parts import part_times
from training_step_floors import step_floors

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.devices import choose_device
from thermosplat.gaussians import Gaussians
from thermosplat.training.trainer import Trainer

WINDOWS = 5
KERNELS = 60
"""Of a step, kept in the report."""


def random_case(
    config: TrainConfig, size: tuple[int, int], count: int, peaks: DevicePeaks, steps: int, repeats: int
) -> dict[str, Any]:
    """Measures a step on random Gaussians and noise.

    Args:
        config: The whole configuration.
        size: Width and height of the images [px].
        count: Gaussians.
        peaks: Measured in the same run.
        steps: Steps of each of ``WINDOWS`` windows of which the median counts.
        repeats: Measurements of each part.

    Returns:
        The case; see :func:`step_case`.
    """
    gaussians = random_gaussians(count, feature_dim=max(config.model.feature_dim, 1), sh_degree=config.sh_degree)
    return step_case(config, random_capture(*size), peaks, steps, repeats, gaussians=gaussians)


def step_case(
    config: TrainConfig,
    capture: Capture,
    peaks: DevicePeaks,
    steps: int,
    repeats: int,
    *,
    checkpoint: dict[str, Any] | None = None,
    gaussians: Gaussians | None = None,
) -> dict[str, Any]:
    """Measures a step on a capture, from a checkpoint or with given Gaussians.

    Returns:
        ``step_ms`` (median of windows), ``kernels_ms`` and ``host_gap_ms`` (the rest of a step; both None on the CPU),
        ``parts`` with times and floors, ``rest_ms`` (of the kernels, on the CPU of the step, what no part holds),
        ``in_step_ms`` (kernels of the step by the part that their names tell), ``kernels``, and ``memory``.
    """
    device = choose_device(config.device)
    before = _start_memory(device)
    with TemporaryDirectory() as folder:
        trainer = steady_trainer(
            steady_config(config, densifying=True),
            capture,
            Path(folder) / "run",
            checkpoint=checkpoint,
            gaussians=gaussians,
        )
        warm_up(trainer)
        step_ms = float(np.median([1e3 * run_steps(trainer, steps) / steps for _ in range(WINDOWS)]))
        memory = _memory(device, before)
        kernels = step_kernels(trainer)
        parts, error = _parts(trainer, peaks, repeats)
        view = capture.train[0].rgb or capture.train[0].thermal
        case = {
            "scene": capture.name,
            "width": view.camera.width if view else 0,
            "height": view.camera.height if view else 0,
            "gaussians": trainer.model.num_gaussians,
            "step_ms": step_ms,
            **_totals(step_ms, parts, kernels, device),
            "parts": parts,
            "memory": memory,
            "kernels": kernels[:KERNELS],
            **error,
        }
        if trainer.captured is not None:
            trainer.captured.forget()
    return case


def _parts(trainer: Trainer, peaks: DevicePeaks, repeats: int) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Times and floors of the parts; where they cannot be had, none and why: the step as a whole counts more."""
    try:
        times = part_times(trainer, repeats)
        floors = step_floors(trainer, trainer.schedule.tensors(trainer.state.step), peaks)
    except Exception as error:
        traceback.print_exc()
        return {}, {"parts_error": " ".join(f"{type(error).__name__}: {error}".split())[:300]}
    parts = {
        name: {
            "forward_ms": time.forward_ms,
            "backward_ms": time.backward_ms,
            "total_ms": time.total_ms,
            "floor": floors[name],
            "times_floor": time.total_ms / floors[name]["floor_ms"],
        }
        for name, time in times.items()
    }
    return parts, {}


def _totals(
    step_ms: float, parts: dict[str, dict[str, Any]], kernels: list[dict[str, Any]], device: torch.device
) -> dict[str, Any]:
    """What the parts leave over, of the kernels and of the step."""
    parts_ms = sum(part["total_ms"] for part in parts.values())
    floor_ms = sum(part["floor"]["floor_ms"] for part in parts.values())
    totals: dict[str, Any] = {
        "parts_ms": parts_ms,
        "floor_ms": floor_ms,
        "times_floor": step_ms / floor_ms if parts else None,
    }
    if device.type != "cuda":
        return totals | {"kernels_ms": None, "host_gap_ms": None, "rest_ms": step_ms - parts_ms, "in_step_ms": {}}
    kernels_ms = sum(kernel["microseconds"] for kernel in kernels) / 1e3
    return totals | {
        "kernels_ms": kernels_ms,
        "host_gap_ms": step_ms - kernels_ms,
        "rest_ms": kernels_ms - parts_ms,
        "in_step_ms": milliseconds_by_part(kernels),
    }


def _start_memory(device: torch.device) -> dict[str, int]:
    """Bytes that are in use, and that torch holds, before the case; its peaks count from here."""
    gc.collect()
    if device.type != "cuda":
        return {}
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    return {"allocated": torch.cuda.memory_allocated(device), "reserved": torch.cuda.memory_reserved(device)}


def _memory(device: torch.device, before: dict[str, int]) -> dict[str, int] | None:
    """Most bytes in use since, and most that torch held, its graphs' pools included; None on the CPU."""
    if device.type != "cuda":
        return None
    return {
        "allocated_bytes": torch.cuda.max_memory_allocated(device) - before["allocated"],
        "reserved_bytes": torch.cuda.max_memory_reserved(device) - before["reserved"],
    }


def memory_model(cases: list[dict[str, Any]]) -> dict[str, float] | None:
    """Bytes a Gaussian, bytes a pixel and bytes apart from both: the least squares fit to the cases' peaks.

    Args:
        cases: From :func:`random_case`.

    Returns:
        The fit, and its largest relative error; None where fewer than four cases have a peak, or all are of one size or
        count.
    """
    rows = [case for case in cases if case["memory"] is not None]
    counts, pixels = ([float(value) for value in values] for values in _axes(rows))
    if len(rows) < 4 or len(set(counts)) < 2 or len(set(pixels)) < 2:
        return None
    peaks = np.array([case["memory"]["allocated_bytes"] for case in rows], dtype=np.float64)
    # in millions, so that no column dwarfs another
    columns = np.stack([np.array(counts) / 1e6, np.array(pixels) / 1e6, np.ones(len(rows))], axis=1)
    solution = np.linalg.lstsq(columns, peaks, rcond=None)[0]
    errors = np.abs(columns @ solution - peaks) / peaks
    return {
        "bytes_per_gaussian": solution[0] / 1e6,
        "bytes_per_pixel": solution[1] / 1e6,
        "bytes_besides": solution[2],
        "largest_relative_error": errors.max(),
    }


def _axes(rows: list[dict[str, Any]]) -> tuple[list[int], list[int]]:
    return [row["gaussians"] for row in rows], [row["width"] * row["height"] for row in rows]
