"""A training whose steps and waits are noted: what bench_many_images.py starts.

python -m training.timed_training MEASURED.json STEPS PROFILED FLAGS...
"""

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)
import torch

from measuring.device_time import device_time
from measuring.process_memory import memory_of
from measuring.process_time import seconds_of_children
from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.host_settings import prepare_host
from thermosplat.config.run_schedule import in_steps
from thermosplat.datasets import capture_of
from thermosplat.datasets.kept_images import keep_images
from thermosplat.rasterizer.warp_start import start_warp
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.frames.frames_from_disk import FramesFromDisk
from thermosplat.training.trainer import Trainer

READ_ALONE = 64
"""Frames that are read without training."""
LOOK_EVERY = 16
"""Of these frames: those after which memory is looked at, which takes longer than to read one."""
REPEATED = 20
"""How often a part of a frame's way is timed."""


class Notes:
    """What is noted after each step, by a clock that stands still while a profile is started or read.

    Args:
        epoch: Training frames.
        count: Steps.
        profiled: Of the last steps of each epoch but the very last, after which something else may be due; 0: none.
    """

    def __init__(self, epoch: int, count: int, profiled: int) -> None:
        self.steps: list[tuple[float, float, float]] = []
        """Of each: when it ended, the time waited for frames to be read until then, and for the device."""
        self.windows: list[dict[str, float]] = []
        self._stood = 0.0
        self._last = profiled_steps(epoch, count, profiled)
        self._profile: Any = None
        self._began = 0.0

    def __call__(self, trainer: Trainer) -> None:
        """Note a step."""
        now = time.time()
        disk = trainer.frames.from_disk
        ahead = 0.0 if disk is None or disk.copies is None else disk.copies.ahead
        self.steps.append((now - self._stood, 0.0 if disk is None else disk.loader.waited, ahead))
        if self._profile is not None and trainer.step in self._last:
            torch.cuda.synchronize()
            elapsed, stopped, self._profile = time.time() - self._began, self._profile, None
            stopped.stop()
            found, steps = device_time(stopped), trainer.step - self._last[trainer.step]
            window = {"first_step": trainer.step - steps + 1, "step_ms": 1e3 * elapsed / steps}
            idle = max(0.0, 1.0 - found.busy_s / elapsed)
            self.windows.append(window | {"idle": idle, "to_device_ms": 1e3 * found.to_device_s / steps})
        if trainer.step in self._last.values():
            torch.cuda.synchronize()
            self._profile = torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA])
            self._profile.start()
            self._began = time.time()
        self._stood += time.time() - now


def profiled_steps(epoch: int, count: int, profiled: int) -> dict[int, int]:
    """The step before which each profile ends, and the one before which it begins; arguments as of ``Notes``."""
    ends = [*range(epoch - 1, count - 1, epoch), count - 1]
    starts = [0, *ends[:-1]]
    return {end: end - profiled for end, start in zip(ends, starts) if profiled and end - start > profiled}


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
    config = replace(
        in_steps(config), max_steps=count, eval_steps=(), save_steps=(), tensorboard=False, overwrite=False
    )
    trainer = Trainer(config, replace(capture, test=capture.test[:1]), RunDirectory.create(config.result_dir, True))
    moments["trainer made"] = time.time()
    before = memory_of(os.getpid()).total / 1e9
    trainer.between_steps = notes = Notes(
        len(trainer.frames), count, int(profiled) if trainer.device.type == "cuda" else 0
    )
    trainer.train()
    view = next(iter(trainer.frames.frames[0].views.values()))
    disk = trainer.frames.from_disk
    report: dict[str, Any] = {
        "moments": moments,
        "steps": notes.steps,
        "windows": notes.windows,
        "frames": len(trainer.frames),
        "trained_size": f"{view.camera.width}x{view.camera.height}",
        "readers": 0 if disk is None else disk.loader.processes,
        "before_gb": before,
        **({} if disk is None else read_alone(trainer, disk, Path(str(config.result_dir)))),
    }
    Path(told).write_text(json.dumps(report), encoding="utf-8")


def read_alone(trainer: Trainer, disk: FramesFromDisk, folder: Path) -> dict[str, Any]:
    """What reading alone takes: frames per second and the readers' time per frame [ms], decoded and then from what was
    kept; memory [GB]; parts of a frame's way [ms]."""
    found: dict[str, Any] = {"reading_gb": 0.0}
    count = min(READ_ALONE, len(trainer.frames))
    before = memory_of(os.getpid()).total
    for frame in disk.loader.each(range(min(2 * disk.loader.processes, count))):
        disk.loader.release(frame)  # processes are started, and have their tables
    keep_images(trainer.capture, folder)
    for name in ("decoded", "kept"):
        ran, looking, started = seconds_of_children(os.getpid()), 0.0, time.perf_counter()
        for frame in disk.loader.each(range(count)):
            if frame.place % LOOK_EVERY == 0:
                looks = time.perf_counter()
                found["reading_gb"] = max(found["reading_gb"], (memory_of(os.getpid()).total - before) / 1e9)
                looking += time.perf_counter() - looks
            disk.loader.release(frame)
        found[f"{name}_per_s"] = count / (time.perf_counter() - started - looking)
        found[f"{name}_cpu_ms"] = 1e3 * (seconds_of_children(os.getpid()) - ran) / count
    found["frame_mb"] = disk.loader.slot_bytes / 1e6
    found |= parts_of_a_frame(disk, trainer.device)
    disk.close()
    if trainer.capture.on_disk is not None:
        trainer.capture.on_disk.cache.close()
    return found


def parts_of_a_frame(disk: FramesFromDisk, device: torch.device) -> dict[str, float]:
    """Of the way of one frame that was read: to the device, and from there into float32 tensors [ms]."""
    read = disk.loader.at(0, range(1).__getitem__, 1)
    pixels = torch.empty_like(read.pixels, device=device)
    return {
        "copy_ms": each_ms(lambda: pixels.copy_(read.pixels, non_blocking=True), device),
        "convert_ms": each_ms(lambda: disk.of_slot(read.index, pixels), device),
    }


def each_ms(work: Callable[[], object], device: torch.device) -> float:
    """What some work takes, on the device, in the mean of ``REPEATED`` times [ms]."""

    def done() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    work()
    started = done()
    for _ in range(REPEATED):
        work()
    return 1e3 * (done() - started) / REPEATED


if __name__ == "__main__":
    main(sys.argv[1:])
