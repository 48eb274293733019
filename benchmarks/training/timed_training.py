"""A training whose steps and waits are noted: what bench_many_images.py starts.

python -m training.timed_training MEASURED.json STEPS PROFILED FLAGS...
"""

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap: see docs/troubleshooting.md)
import torch

from measuring.process_memory import memory_of
from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.host_settings import prepare_host
from thermosplat.datasets import capture_of
from thermosplat.datasets.kept_images import keep_images
from thermosplat.rasterizer.warp_start import start_warp
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer

READ_ALONE = 64
"""Frames that are read without training."""


def main(words: list[str]) -> None:
    """Train, and write what was noted."""
    told, steps, profiled, *flags = words
    prepare_host()
    config = parse_train_arguments(flags)
    moments = {"imported": time.time()}
    capture = capture_of(config)
    moments["capture known"] = time.time()
    start_warp()
    count = 2 * len(capture.train) if steps == "None" else int(steps)
    config = replace(config, max_steps=count, eval_steps=(), save_steps=(), tensorboard=False, overwrite=False)
    trainer = Trainer(config, replace(capture, test=capture.test[:1]), RunDirectory.create(config.result_dir, True))
    moments["trainer made"] = time.time()
    before = memory_of(os.getpid()).total / 1e9
    noted: list[tuple[float, float]] = []
    last = int(profiled) if trainer.device.type == "cuda" else 0
    profile = torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) if last else None
    began = [0.0]

    def note(trainer: Trainer) -> None:
        noted.append((time.time(), waited(trainer)))
        if profile is not None and trainer.step == count - 1 - last:
            torch.cuda.synchronize()
            profile.start()
            began[0] = time.time()
        if profile is not None and trainer.step == count - 1:
            torch.cuda.synchronize()
            began[0] = time.time() - began[0]
            profile.stop()

    trainer.between_steps = note
    trainer.train()
    idle = None
    if profile is not None:
        busy = sum(event.self_device_time_total for event in profile.key_averages() if not event.key.startswith("Mem"))
        idle = max(0.0, 1.0 - 1e-6 * busy / began[0])
    view = next(iter(trainer.frames.frames[0].views.values()))
    report: dict[str, Any] = {
        "moments": moments,
        "steps": noted,
        "frames": len(trainer.frames),
        "trained_size": f"{view.camera.width}x{view.camera.height}",
        "readers": 0 if trainer.frames.from_disk is None else trainer.frames.from_disk.loader.workers,
        "before_gb": before,
        "gpu_idle": idle,
        **read_alone(trainer, Path(str(config.result_dir))),
    }
    Path(told).write_text(json.dumps(report), encoding="utf-8")


def waited(trainer: Trainer) -> float:
    """Seconds that steps have waited for frames so far."""
    return 0.0 if trainer.frames.from_disk is None else trainer.frames.from_disk.loader.waited


def read_alone(trainer: Trainer, folder: Path) -> dict[str, float | None]:
    """What reading alone takes: frames per second, decoded and then from what was kept; and memory [GB]."""
    found: dict[str, float | None] = {"reading_gb": None}
    keep_images(trainer.capture, folder)
    before = memory_of(os.getpid()).total
    for name in ("decoded_per_s", "kept_per_s"):
        found[name] = None
        if trainer.frames.from_disk is not None:
            loader, count = trainer.frames.from_disk.loader, min(READ_ALONE, len(trainer.frames))
            started = time.time()
            for _ in loader.each(range(count)):
                taken = (memory_of(os.getpid()).total - before) / 1e9
                found["reading_gb"] = max(taken, found["reading_gb"] or 0.0)
            found[name] = count / (time.time() - started)
    if trainer.capture.on_disk is not None:
        trainer.capture.on_disk.cache.close()
    return found


if __name__ == "__main__":
    main(sys.argv[1:])
