"""Whole training runs by the command's own entry, each in a process of its own: seconds, quality, memory over time."""

import json
import os
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from training.command import failure, run_python

ENTRY = Path(__file__).with_name("clocked_training.py")
PLAIN = ("--no-graph", "--no-compile")
MEMORY_SHARES = (0.3, 0.5, 1.0)
"""Shares of the steps at which the peak memory so far is taken; Gaussians are added in the first half of a run."""


def whole_runs(
    command: Sequence[str], seeds: Sequence[int], folder: Path, remaining_s: float, *, plain: bool, deterministic: bool
) -> Iterator[dict[str, Any]]:
    """Trains, and yields a row for each run as soon as it is done.

    Args:
        command: Arguments of thermosplat-train, the capture first.
        seeds: One run of each kind for each.
        folder: Where the runs go.
        remaining_s: What is still running after so long is stopped, and nothing more is started [s].
        plain: Also run with ``--no-graph --no-compile``.
        deterministic: Also run with ``--deterministic``, with the first seed twice, and compare the two models.
    """
    kinds: list[tuple[str, tuple[str, ...]]] = [("default", ())]
    kinds += [("plain loop", PLAIN)] * plain + [("deterministic", ("--deterministic",))] * deterministic
    started = time.perf_counter()
    for seed in seeds:
        default: dict[str, Any] = {}
        for kind, flags in kinds:
            out = folder / f"{kind.replace(' ', '_')}_{seed}"
            arguments = [*command, *flags, "--seed", str(seed)]
            row: dict[str, Any] = {"kind": kind, "seed": seed}
            row |= _run(arguments, out, remaining_s - (time.perf_counter() - started))
            if kind == "default":
                default = row
            elif "error" not in row and "error" not in default:
                row["psnr_from_default"] = {
                    spectrum: row["psnr"][spectrum] - value for spectrum, value in default["psnr"].items()
                }
                row["times_default"] = row["ms_a_step"] / default["ms_a_step"]
            if kind == "deterministic" and seed == seeds[0] and "error" not in row:
                again = folder / f"{out.name}_again"
                second = _run(arguments, again, remaining_s - (time.perf_counter() - started))
                row["same_bits_twice"] = second["error"] if "error" in second else _same_model(out, again)
            yield row


def sample_run(flags: Sequence[str], folder: Path, limit_s: float, *, cores: int, cold: bool) -> dict[str, Any]:
    """``thermosplat-train sample`` on the CPU; the row is one of :func:`whole_runs`, with ``cores`` and ``cold``.

    Args:
        flags: Of thermosplat-train.
        folder: Where the run goes.
        limit_s: It is stopped after so long [s].
        cores: Processor cores it may use.
        cold: With an empty cache of Warp's kernels, so that all are compiled.
    """
    environment = {"OMP_NUM_THREADS": str(cores)} | ({"WARP_CACHE_PATH": str(folder / "kernels")} if cold else {})
    row: dict[str, Any] = {"kind": "sample", "cores": cores, "cold": cold}
    with _on_cores(cores):
        return row | _run(["sample", *flags, "--device", "cpu"], folder / "sample", limit_s, environment)


@contextmanager
def _on_cores(count: int) -> Iterator[None]:
    """While open, processes that this thread starts keep to so many cores."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(allowed)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def _run(
    arguments: Sequence[str], out: Path, limit_s: float, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """One run; its row holds ``error`` where it failed or did not end in time."""
    if limit_s <= 0:
        return {"error": "not started: the time limit"}
    clock = out.with_name(f"{out.name}_compilation.json")
    words = [*arguments, "--result-dir", str(out), "--overwrite"]
    begun, started = time.time(), time.perf_counter()
    try:
        done = run_python([str(ENTRY), str(clock), *words], environment or {}, limit_s)
    except subprocess.TimeoutExpired:
        return {"error": "stopped: the time limit"}
    seconds = time.perf_counter() - started
    run = RunDirectory(out)
    if error := failure(done):
        return {"error": error}
    compilation = json.loads(clock.read_text(encoding="utf-8"))
    return {"process_s": seconds} | _row(run, run.metrics_json.stat().st_mtime - begun, compilation)


def _row(run: RunDirectory, seconds: float, compilation: dict[str, float]) -> dict[str, Any]:
    metrics = json.loads(run.metrics_json.read_text(encoding="utf-8"))
    steps, first_s = metrics["steps"], metrics["first_step_seconds"]
    compiling_s = first_s + compilation["late_compile_s"]
    evaluated = {spectrum: metrics[spectrum] for spectrum in metrics["spectra"] if metrics[spectrum]}
    return {
        "seconds": seconds,
        "first_step_s": first_s,
        **compilation,
        "seconds_without_compilation": seconds - compiling_s,
        "train_s": metrics["train_seconds"],
        "ms_a_step": 1e3 * (metrics["train_seconds"] - compiling_s) / max(steps - 1, 1),
        "steps": steps,
        "num_gaussians": metrics["num_gaussians"],
        "psnr": {spectrum: values["psnr"] for spectrum, values in evaluated.items()},
        "metrics": evaluated,
        "memory": _memory(run, steps),
    }


def _memory(run: RunDirectory, steps: int) -> list[dict[str, Any]]:
    """Peak memory so far and Gaussians at shares of the run, from metrics.jsonl."""
    lines = [json.loads(line) for line in run.metrics_jsonl.read_text(encoding="utf-8").splitlines()]
    logged = [line for line in lines if "memory_bytes" in line]
    found = []
    for share in MEMORY_SHARES:
        line = next(line for line in logged if line["step"] >= share * steps)
        found.append({key: line[key] for key in ("step", "memory_bytes", "num_gaussians")})
    return found


def _same_model(first: Path, second: Path) -> bool:
    """Whether two runs ended with the same bits in Gaussians and decoders."""
    paths = [RunDirectory(folder).latest_checkpoint() for folder in (first, second)]
    return _equal(*(vars(load_checkpoint(path).model) if path is not None else None for path in paths))


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    return bool(a == b)
