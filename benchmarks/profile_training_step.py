"""Where a training step's time goes: milliseconds a step, and the kernels of a step by name.

    python benchmarks/profile_training_step.py DATA --steps 1500 --max-gaussians 300000

Trains with the chosen preset to ``--steps``, times 60 steps between two refinements, then profiles 20 more.
"""

import argparse
import dataclasses
import json
import tempfile
import time
from pathlib import Path

import torch
from torch.profiler import ProfilerActivity, profile

from thermosplat.config_files import load_config
from thermosplat.datasets import load_capture
from thermosplat.devices import device_name
from thermosplat.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer

TIMED, PROFILED = 60, 20
"""Steps that are timed, and steps that are profiled."""


def main(arguments: list[str] | None = None) -> None:
    """Run it; prints a table, and writes ``--output`` as JSON.

    Args:
        arguments: Command line; None: the process's own.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="folder of a capture, or sample")
    parser.add_argument("--config", default="thermosplat")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--steps", type=int, default=1500, help="train so far first")
    parser.add_argument("--max-gaussians", type=int)
    parser.add_argument("--data-factor", type=int, default=1)
    parser.add_argument("--no-graph", action="store_true")
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--precision", default="tf32", choices=["float32", "tf32", "bfloat16"])
    parser.add_argument("--kernels", type=int, default=40, help="lines of the table")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args(arguments)

    config = load_config(options.config)
    config = dataclasses.replace(
        config,
        device=options.device,
        max_steps=30_000,
        eval_steps=(),
        save_steps=(),
        graph=not options.no_graph,
        compile=config.compile and not options.no_compile,
        decoder_precision=options.precision,
        densification=dataclasses.replace(config.densification, max_gaussians=options.max_gaussians),
    )
    capture = load_capture(options.data, data_factor=options.data_factor)
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(config, capture, RunDirectory.create(Path(folder) / "run"))
        _train_to(trainer, options.steps)
        result = _measure(trainer)
    print(f"{device_name(trainer.device)}, {capture.name}, {result['num_gaussians']:,} Gaussians")
    print(f"{result['milliseconds']:.2f} ms a step; kernels {sum(k['microseconds'] for k in result['kernels']):.0f} µs")
    for kernel in result["kernels"][: options.kernels]:
        print(f"{kernel['microseconds']:9.1f} µs {kernel['calls']:6.1f}  {kernel['name'][:110]}")
    if options.output is not None:
        options.output.write_text(json.dumps(result, indent=1))


def _train_to(trainer: Trainer, step: int) -> None:
    while trainer.step < step:
        trainer._train_step()
    _wait(trainer)


def _measure(trainer: Trainer) -> dict:
    """Milliseconds of a step, and its kernels: microseconds and calls of each, both a step."""
    every = trainer.config.densification.every
    _train_to(trainer, trainer.step + (20 - trainer.step) % every)  # a stretch without refinement
    started = time.perf_counter()
    _train_to(trainer, trainer.step + min(TIMED, every - 40))
    milliseconds = (time.perf_counter() - started) / min(TIMED, every - 40) * 1e3
    _train_to(trainer, trainer.step + (20 - trainer.step) % every)
    on_cuda = trainer.device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if on_cuda else ProfilerActivity.CPU]) as recorded:
        _train_to(trainer, trainer.step + PROFILED)
    kernels = []
    for event in recorded.key_averages():
        total = event.self_device_time_total if on_cuda else event.self_cpu_time_total
        if total > 0:
            kernels.append({"name": event.key, "microseconds": total / PROFILED, "calls": event.count / PROFILED})
    return {
        "milliseconds": milliseconds,
        "num_gaussians": trainer.model.num_gaussians,
        "device": device_name(trainer.device),
        "kernels": sorted(kernels, key=lambda kernel: -kernel["microseconds"]),
    }


def _wait(trainer: Trainer) -> None:
    if trainer.device.type == "cuda":
        torch.cuda.synchronize(trainer.device)


if __name__ == "__main__":
    main()
