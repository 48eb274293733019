"""Whole trainings by thermosplat-train, each in a process of its own: seconds, quality, and memory over the steps."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from thermosplat.checkpoint import load_checkpoint
from thermosplat.run_directory import RunDirectory

COMMAND = Path(__file__).with_name("clocked_training.py")

VARIANTS = {"default": (), "plain": ("--no-graph", "--no-compile"), "deterministic": ("--deterministic",)}
"""Flags of each way to run the same training."""


def training_run(
    data: str,
    flags: list[str],
    folder: Path,
    *,
    cores: int | None = None,
    kernel_cache: Path | None = None,
) -> dict[str, Any]:
    """Trains once.

    Args:
        data: Folder of a capture, or "sample".
        flags: Of thermosplat-train.
        folder: Where the run goes; what an earlier one left there is deleted.
        cores: Processor cores that the process may use; None: all.
        kernel_cache: Folder of Warp's compiled kernels; None: the user's.

    Returns:
        ``seconds`` from the command to metrics.json and, of these, ``first_step_seconds`` (in which kernels are
        compiled where the cache has none) and ``late_compile_seconds``; ``compiled_seconds`` without either;
        ``train_seconds`` and, likewise without either, ``step_ms``; the held-out PSNR of
        either spectrum, Gaussians, steps, ``memory`` over the steps, and ``model_hash`` of the trained parameters.
        ``error`` in place of all that where the command failed.
    """
    clock = folder.with_name(f"{folder.name}_compilation.json")
    command = [sys.executable, str(COMMAND), str(clock), data, *flags, "--result-dir", str(folder), "--overwrite"]
    environment = dict(os.environ)
    if cores is not None:
        environment["OMP_NUM_THREADS"] = str(cores)
    if kernel_cache is not None:
        environment["WARP_CACHE_PATH"] = str(kernel_cache)
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    started, started_at = time.perf_counter(), time.time()
    with _on_cores(cores):
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    process_seconds = time.perf_counter() - started
    if done.returncode != 0:
        return {"error": f"exit code {done.returncode}: {' '.join((done.stderr or done.stdout).split())[-600:]}"}
    run = RunDirectory.open(folder)
    metrics = json.loads(run.metrics_json.read_text(encoding="utf-8"))
    compilation = json.loads(clock.read_text(encoding="utf-8"))
    seconds, first = run.metrics_json.stat().st_mtime - started_at, metrics["first_step_seconds"]
    late = compilation["late_compile_seconds"]
    return {
        "seconds": seconds,
        "process_seconds": process_seconds,
        "first_step_seconds": first,
        **compilation,
        "compiled_seconds": seconds - first - late,
        "train_seconds": metrics["train_seconds"],
        "step_ms": 1e3 * (metrics["train_seconds"] - first - late) / max(metrics["steps"] - 1, 1),
        "steps": metrics["steps"],
        "num_gaussians": metrics["num_gaussians"],
        "rgb_psnr": (metrics["rgb"] or {}).get("psnr"),
        "thermal_psnr": (metrics["thermal"] or {}).get("psnr"),
        "memory": memory_growth(run),
        "model_hash": model_hash(run),
        "device": metrics["device"],
    }


def whole_runs(
    data: str, flags: list[str], seeds: list[int], variants: list[str], folder: Path
) -> Iterator[dict[str, Any]]:
    """Trains with every seed, each variant one after the other, and yields the runs.

    Args:
        data: As for :func:`training_run`.
        flags: Likewise, for all of them.
        seeds: The seeds.
        variants: Of ``VARIANTS``; "deterministic" trains twice with the first seed, to compare the results, and not
            with the others.
        folder: Where the runs go, in a folder each.

    Yields:
        What :func:`training_run` returns, with ``seed``, ``variant`` and ``folder``.
    """
    for seed in seeds:
        for variant in variants:
            twice = variant == "deterministic"
            if twice and seed != seeds[0]:
                continue
            for repetition in range(2 if twice else 1):
                name = f"{variant}_{seed}" + (f"_{repetition + 1}" if twice else "")
                run = training_run(data, [*flags, "--seed", str(seed), *VARIANTS[variant]], folder / name)
                yield {"seed": seed, "variant": variant, "folder": str(folder / name)} | run


def differences(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """What the variants change: PSNR of each seed against the plain loop's, and whether deterministic runs are equal.

    Args:
        runs: From :func:`whole_runs`, those that failed included.

    Returns:
        ``to_plain``: for each seed with both runs the default's PSNR minus the plain loop's [dB], by spectrum;
        ``deterministic_equal``: whether both deterministic runs ended with the same bits; None without two.
    """
    finished = [run for run in runs if "error" not in run]
    of = {(run["variant"], run["seed"]): run for run in finished}
    to_plain = {
        str(seed): {
            name: None if run[name] is None else run[name] - of["plain", seed][name]
            for name in ("rgb_psnr", "thermal_psnr")
        }
        for (variant, seed), run in of.items()
        if variant == "default" and ("plain", seed) in of
    }
    hashes = [run["model_hash"] for run in finished if run["variant"] == "deterministic"]
    return {"to_plain": to_plain, "deterministic_equal": hashes[0] == hashes[1] if len(hashes) == 2 else None}


def memory_growth(run: RunDirectory) -> dict[str, Any]:
    """Peak memory over the steps of a finished run, from metrics.jsonl.

    The peak only ever rises; what it rises by when Gaussians have stopped to be added grows without a reason.

    Args:
        run: The run.

    Returns:
        ``samples``, about ten of step, Gaussians and peak bytes, and ``late_growth_bytes`` from ``late_from_step`` to
        the end: the later of half the run and of the second line with the last number of Gaussians. None where fewer
        than two lines are left there.
    """
    lines = [json.loads(line) for line in run.metrics_jsonl.read_text(encoding="utf-8").splitlines()]
    rows = [line for line in lines if "memory_bytes" in line]
    picked = rows[:: max(len(rows) // 10, 1)]
    if rows and picked[-1] is not rows[-1]:
        picked.append(rows[-1])
    samples = [{key: row[key] for key in ("step", "num_gaussians", "memory_bytes")} for row in picked]
    changed = [row["step"] for before, row in pairwise(rows) if row["num_gaussians"] != before["num_gaussians"]]
    half = rows[-1]["step"] / 2 if rows else 0
    late = [row for row in rows if row["step"] >= half and row["step"] > max(changed, default=0)]
    grown = late[-1]["memory_bytes"] - late[0]["memory_bytes"] if len(late) > 1 else None
    return {
        "samples": samples,
        "late_from_step": late[0]["step"] if late else None,
        "late_growth_bytes": grown,
    }


def model_hash(run: RunDirectory) -> str:
    """SHA-256 of the newest checkpoint's Gaussians and decoders, bit for bit.

    Args:
        run: The run.
    """
    digest = hashlib.sha256()
    path = run.latest_checkpoint()
    if path is not None:
        _digest(load_checkpoint(path)["model"], digest)
    return digest.hexdigest()


def _digest(value: Any, digest: "hashlib._Hash") -> None:
    if isinstance(value, torch.Tensor):
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    elif isinstance(value, dict):
        for key in sorted(value):
            digest.update(str(key).encode())
            _digest(value[key], digest)
    else:
        digest.update(repr(value).encode())


@contextmanager
def _on_cores(count: int | None) -> Iterator[None]:
    """While open, processes that this thread starts keep to so many cores."""
    if count is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(allowed)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)
