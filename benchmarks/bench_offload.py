"""What does training cost when spherical harmonics, features and Adam's moments of them lie in the host's memory?

    python benchmarks/bench_offload.py --gaussians 20000000 --size 1280x1024 --share 0.1 --limit 15 --offload off auto
    python benchmarks/bench_offload.py --device cpu --gaussians 2000 --size 64x48 --steps 2

Random Gaussians lie all around cameras that look in different directions, each at a share of them. Their order is
random, so that every row is fetched by itself. Steps are those of thermosplat-train while density control takes notes;
without offloading they are recorded as CUDA graphs. With ``--limit`` torch gets so much of the GPU's memory and no more
when something is offloaded. ``auto`` decides as thermosplat-train does for a training that may still refine.

A row says how long a step takes, each waited for and in a row, how much memory torch has reserved on the GPU, how much
is in use on it (with CUDA's own), and how many Gaussians are in view. Of steps that offload, further steps in which the
device is waited for say how long it takes to find out what is in view and to fetch it, and to update it. A row also
says for which share of the Gaussians moments are on the device, and how many bytes the update reads over the bus. With
``--refine`` a hundredth of the Gaussians is copied at the end, which takes three times a step's part of the host's
memory.
"""

import argparse
import gc
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from measuring.timing import wait
from scenes.panorama import panorama_capture, panorama_values
from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.config import DensificationConfig
from thermosplat.fused.row_adam import RowAdam
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.devices import choose_device
from thermosplat.runs.environment import environment
from thermosplat.runs.run_directory import finite_or_null
from thermosplat.scene import model as scene_model
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.torch_bridge.host_rows import row_length
from thermosplat.training.density.gaussian_ops import append_copies, parameter_like, replace_parameters
from thermosplat.training.offloading import limit_device_memory
from thermosplat.training.trainer import Trainer
from training.frozen_training import frozen, quiet_trainer, run_steps, warm_up

NEVER = 10**11
NOTING = DensificationConfig(start_step=NEVER, stop_step=2 * NEVER, every=NEVER, reset_every=NEVER)
"""Density control looks at every step and changes nothing."""


def filled_trainer(options: argparse.Namespace, kind: str, folder: Path, size: tuple[int, int]) -> Trainer:
    """A trainer of the random Gaussians that has done no step.

    Args:
        options: The script's.
        kind: ``--offload``.
        folder: For its files.
        size: Of the images [px].
    """
    words = ["sample", "--config", options.config, "--device", options.device, "--offload", kind]
    densification = replace(NOTING, max_gaussians=options.gaussians)
    config = replace(frozen(parse_train_arguments(words)), densification=densification)
    if kind == "auto":
        config = replace(config, gpu_memory=options.limit)
    trainer = quiet_trainer(config, panorama_capture(options.share, *size), folder)
    state = trainer.state
    for owner, gaussians in state.gaussian_sets.items():
        for name, parameter in list(gaussians.named_parameters()):
            values = panorama_values(name, options.gaussians, parameter.shape[1:], options.share, trainer.device, 7)
            new = parameter_like(parameter, values)
            del values
            replace_parameters(gaussians, state.optimizers[owner], {name: (new, {})})
        state.strategies[owner].forget(len(gaussians))
    state.step = config.sh_degree + 1  # all degrees from the next step on
    return trainer


@contextmanager
def parts_timed(device: torch.device) -> Iterator[dict[str, list[float]]]:
    """While this is open the device is waited for around the parts of a step that offloading adds; their times [ms]."""
    found: dict[str, list[float]] = {"found and fetched": [], "updated": []}

    def timed(name: str, part: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            wait(device)
            started = time.perf_counter()
            result = part(*args, **kwargs)
            wait(device)
            found[name].append(1e3 * (time.perf_counter() - started))
            return result

        return run

    fetch, update = scene_model.gaussians_in_view, RowAdam.step_rows
    scene_model.gaussians_in_view = timed("found and fetched", fetch)
    RowAdam.step_rows = timed("updated", update)  # type: ignore[method-assign]
    try:
        yield found
    finally:
        scene_model.gaussians_in_view = fetch
        RowAdam.step_rows = update  # type: ignore[method-assign]


def moments_of(trainer: Trainer, rendered: RenderedFrame) -> tuple[float, float]:
    """For which share of the Gaussians moments are on the device, and what an update of a frame reads of the others'
    over the bus [GB]; it writes as much, and parameters that are in the host's memory."""
    near, read, state = 0, 0, trainer.state
    for name, gaussians in rendered.in_view.items():
        for optimizer in state.row_optimizers(name):
            here = min(optimizer.rows_on_device, len(optimizer.parameter))
            near = max(near, here)
            read += 8 * row_length(optimizer.parameter) * int((gaussians.indices >= here).sum())
    return near / trainer.model.num_gaussians, read / 1e9


def refined(trainer: Trainer) -> dict[str, float]:
    """Copy a hundredth of the Gaussians, twice: the second time memory of the host is pinned already."""
    found = {}
    for name in ("first", "next"):
        if trainer.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(trainer.device)
        wait(trainer.device)
        started = time.perf_counter()
        for owner, gaussians in trainer.state.gaussian_sets.items():
            indices = torch.arange(0, len(gaussians), 100, device=trainer.device)
            append_copies(gaussians, trainer.state.optimizers[owner], indices)
        wait(trainer.device)
        found[f"{name}_refinement_seconds"] = time.perf_counter() - started
        if trainer.device.type == "cuda":
            found[f"{name}_refinement_gb"] = torch.cuda.max_memory_allocated(trainer.device) / 1e9
    return found


def measured(options: argparse.Namespace, kind: str, size: tuple[int, int], device: torch.device) -> dict[str, Any]:
    """The row of one kind of offloading."""
    on_cuda = device.type == "cuda"
    row: dict[str, Any] = {
        "offload": kind,
        "gaussians": options.gaussians,
        "size": options.size,
        "share": options.share,
    }
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        trainer = filled_trainer(options, kind, Path(folder) / "run", size)
        wait(device)
        if on_cuda:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(device)
            if kind != "off" and options.limit is not None:
                limit_device_memory(device, options.limit)
                row["limit_gb"] = options.limit
        warm_up(trainer)
        row["seconds_before"] = time.perf_counter() - started
        times = [1e3 * run_steps(trainer, 1) for _ in range(options.steps)]
        row["ms_per_step"] = sum(times) / len(times)
        row["fastest_ms"] = min(times)
        row["ms_in_a_row"] = 1e3 * run_steps(trainer, options.steps) / options.steps
        if on_cuda:
            free, total = torch.cuda.mem_get_info(device)
            row["reserved_gb"] = torch.cuda.max_memory_reserved(device) / 1e9
            row["in_use_gb"] = (total - free) / 1e9
        row["offloaded"] = trainer.parts.scenes.offloading.kind
        if trainer.parts.scenes.offloading.kind != "nothing":
            with parts_timed(device) as parts:
                run_steps(trainer, options.steps)
            row |= {f"{name}_ms": sum(found) / options.steps for name, found in parts.items()}
        frame = trainer.frames[0]
        with torch.no_grad():
            rendered = trainer.model.render(frame.views, sh_degree=trainer.config.sh_degree)
        in_view = [len(some.indices) for some in rendered.in_view.values()]
        row["in_view"] = sum(in_view) if in_view else None
        if in_view:
            row["moments_on_device"], row["update_reads_gb"] = moments_of(trainer, rendered)
        del rendered, frame
        if options.refine:
            row |= refined(trainer)
        del trainer
    gc.collect()
    if on_cuda:
        torch.cuda.empty_cache()
        torch.cuda.set_per_process_memory_fraction(1.0, device)
    return row


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--config", default="thermosplat", help="preset")
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--size", default="1280x1024", help="of the images [px]")
    parser.add_argument("--share", type=float, default=0.1, help="of the Gaussians that a camera looks at, below 1/6")
    parser.add_argument("--offload", nargs="+", default=["off", "moments", "on"], help="kinds to measure")
    parser.add_argument(
        "--limit", type=float, default=None, help="of the GPU's memory where something is offloaded [GB]"
    )
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--refine", action="store_true", help="also copy a hundredth of the Gaussians, twice")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    options = parser.parse_args()
    device = choose_device(options.device)
    width, height = map(int, options.size.split("x"))
    report: dict[str, Any] = {"date": time.strftime("%Y-%m-%d"), "environment": environment(device), "rows": []}
    for kind in options.offload:
        try:
            row = measured(options, kind, (width, height), device)
        except torch.OutOfMemoryError as error:
            row = {"offload": kind, "error": str(error).splitlines()[0]}
        report["rows"].append(row)
        print(json.dumps(finite_or_null(row)), flush=True)
        if options.json is not None:
            write_text(options.json, json.dumps(finite_or_null(report), indent=1) + "\n")


if __name__ == "__main__":
    main()
