"""How fast is training, where does a step go, beside whom, and how much memory does it take?

    python benchmarks/bench_training.py DATA --parts whole peers step memory --json training.json \\
        --markdown training.md --time-limit 300 -- --densification.max-gaussians 300000
    python benchmarks/bench_training.py sample --device cpu --parts whole -- --config demo

What follows ``--`` are flags of thermosplat-train: they hold for every part. Files are rewritten after every row.
README.md says what each part measures.
"""

import argparse
import functools
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  (before pycolmap, see src/thermosplat/datasets/lens.py)

from measuring.device_peaks import measure_peaks
from peers.training_steps import compare_steps
from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.host_settings import prepare_host
from thermosplat.config import TrainConfig
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.rasterizer.warp_start import start_warp
from thermosplat.runs.atomic_writes import write_text
from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.devices import choose_device
from thermosplat.runs.environment import environment
from thermosplat.runs.run_directory import RunDirectory, finite_or_null
from thermosplat.training.session.resuming import check_resumable, newest_checkpoint
from training.command import apart
from training.frozen_training import Frames
from training.sizes import capture_rows, memory_fit, profiled_row, synthetic_row
from training.tables import markdown
from training.warm_training import warm_training
from training.whole import sample_run, whole_runs

PARTS = ("whole", "peers", "step", "memory", "sample")
SIZES, COUNTS = ("640x480", "1280x1024"), (100_000, 300_000, 1_000_000)


def arguments(words: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """The script's own options, and the flags of thermosplat-train after ``--``."""
    words, flags = apart(words)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="folder of a capture, or sample")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS[:4]), help="default all but sample")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--seeds", type=int, nargs="+", default=[42], help="of the whole runs")
    parser.add_argument("--plain", action="store_true", help="on CUDA also --no-graph --no-compile")
    parser.add_argument("--deterministic", action="store_true", help="also whole runs with --deterministic")
    parser.add_argument("--cores", type=int, default=2, help="of the CPU that the part sample may use")
    parser.add_argument("--warm-cache", action="store_true", help="the part sample: with the kernels compiled before")
    parser.add_argument("--warm-steps", type=int, default=2000, help="train so far before peers and steps are timed")
    parser.add_argument("--run", default=None, help="take the Gaussians of this result folder of DATA instead")
    parser.add_argument("--window", type=int, default=None, help="steps a measurement (40 on CUDA, 3 on the CPU)")
    parser.add_argument("--rounds", type=int, default=None, help="measurements of each (9 on CUDA, 3 on the CPU)")
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="WIDTHxHEIGHT of the random scenes")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="Gaussians of the random scenes")
    parser.add_argument("--kernels", type=int, default=0, help="print so many kernels of a step by name")
    parser.add_argument("--time-limit", type=float, default=float("inf"), help="start nothing after so long [s]")
    parser.add_argument("--json", type=Path, default=None, help="file to write")
    parser.add_argument("--markdown", type=Path, default=None, help="file to write the tables to")
    return parser.parse_args(words), flags


class Benchmark:
    """One run of the script: what was asked for, and the report that grows.

    Args:
        options: The script's own.
        flags: Those of thermosplat-train, without DATA.
    """

    def __init__(self, options: argparse.Namespace, flags: list[str]) -> None:
        self.options = options
        self.flags = flags
        self.device = choose_device(options.device)
        on_cuda = self.device.type == "cuda"
        self.window = options.window or (40 if on_cuda else 3)
        self.rounds = options.rounds or (9 if on_cuda else 3)
        self.command = [options.data, *flags, "--device", str(self.device)]
        self.config: TrainConfig = parse_train_arguments(self.command)
        self.frames: Frames = {}
        self.started = time.perf_counter()
        self.plain = options.plain and on_cuda  # on the CPU there is neither graph nor compilation
        self.report: dict[str, Any] = {
            "command": " ".join(["python", "benchmarks/bench_training.py", *sys.argv[1:]]),
            "date": time.strftime("%Y-%m-%d"),
            "environment": environment(self.device),
            "config": self.config.config,
            "stopped": [],
            "errors": {},
        }

    @property
    def remaining_s(self) -> float:
        """Of the time limit [s]."""
        return self.options.time_limit - (time.perf_counter() - self.started)

    def save(self) -> None:
        """Replaces the files, so that they are whole at any time."""
        for path, text in (
            (self.options.json, lambda: json.dumps(finite_or_null(self.report), indent=1) + "\n"),
            (self.options.markdown, lambda: markdown(self.report)),
        ):
            if path is not None:
                write_text(path, text())

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Around one part: what goes wrong in it is reported, and the next part goes on."""
        try:
            yield
        except Exception as error:  # out of memory, say, must not lose the other parts
            traceback.print_exc()
            self.report["errors"][name] = f"{type(error).__name__}: {error}".splitlines()[0]
        self.save()

    def late(self, what: str) -> bool:
        """Whether the time limit is over; then that is noted."""
        if self.remaining_s > 0:
            return False
        self.report["stopped"].append(what)
        print(f"the time limit came before: {what}", flush=True)
        return True

    @functools.cached_property
    def capture(self) -> Capture:
        """The capture, read as the command reads it."""
        config = self.config
        return load_capture(
            config.data, data_factor=config.data_factor, test_every=config.test_every, spectra=config.spectra
        )

    @functools.cached_property
    def checkpoint(self) -> Checkpoint:
        """The state of ``--run``, or after the warm-up steps."""
        if self.options.run is not None:
            run = RunDirectory.open(self.options.run)
            checkpoint = newest_checkpoint(run)
            check_resumable(checkpoint, self.config, run, self.capture)
            self.report["densification"] = None
            return checkpoint
        config = replace(self.config, budget="fixed")
        checkpoint, self.report["densification"] = warm_training(
            config, self.capture, self.options.warm_steps, self.frames
        )
        return checkpoint

    @functools.cached_property
    def row(self) -> Callable[..., dict[str, Any]]:
        """``profiled_row`` with this machine's peaks."""
        peaks = measure_peaks(self.device)
        self.report["peaks"] = peaks._asdict()
        return functools.partial(profiled_row, peaks=peaks, window=self.window, rounds=self.rounds)

    def whole(self) -> None:
        """Part 1."""
        options = self.options
        rows = self.report["whole"] = []
        with tempfile.TemporaryDirectory() as folder:
            kinds = {"plain": self.plain, "deterministic": options.deterministic}
            for row in whole_runs(self.command, options.seeds, Path(folder), self.remaining_s, **kinds):
                rows.append(row)
                print({key: value for key, value in row.items() if key not in ("metrics", "memory")}, flush=True)
                self.save()

    def sample(self) -> None:
        """The packaged capture on the CPU."""
        options = self.options
        if not self.late("sample"):
            with tempfile.TemporaryDirectory() as folder:
                limits = {"cores": options.cores, "cold": not options.warm_cache}
                row = sample_run(self.flags, Path(folder), self.remaining_s, **limits)
            self.report["sample"] = row
            print({key: value for key, value in row.items() if key not in ("metrics", "memory")}, flush=True)

    def peers(self) -> None:
        """Part 2."""
        if not self.late("peers"):
            start = (self.config, self.capture, self.checkpoint, self.frames)
            found = compare_steps(*start, self.device, self.window, self.rounds)
            self.report["peers"] = found
            for name, times in found["peers"].items():
                print(f"{times['steps_per_s']:8.1f} steps/s {times['median_ms']:8.2f} ms  {name}", flush=True)
            for name, reason in found["left_out"].items():
                print(f"left out: {name}: {reason}", flush=True)

    def step(self) -> None:
        """Part 3, on the capture."""
        if not self.late("step on the capture"):
            rows = capture_rows(self.config, self.capture, self.checkpoint, self.frames, self.plain, self.row)
            self.report["step"] = rows
            for row in rows:
                print_row(row, self.options.kernels)
            if self.options.run is None:
                none = f"no refinement to time in the {self.options.warm_steps} warm-up steps"
                print("densification:", self.report["densification"] or none, flush=True)

    def sizes(self) -> None:
        """Part 3 on random Gaussians, and part 4."""
        rows = self.report["sizes"] = []
        for size in self.options.sizes:
            width, height = (int(number) for number in size.lower().split("x"))
            for count in self.options.counts:
                name = f"{count:,} Gaussians at {size}"
                if self.late(name):
                    return
                with self.part(name):
                    row = self.row if "step" in self.options.parts else None
                    rows.append(synthetic_row(self.config, count, (width, height), row))
                    print_row(rows[-1], self.options.kernels)
        if "memory" in self.options.parts:
            self.report["memory"] = memory_fit(rows)
            print("memory:", self.report["memory"] or "not measured (needs CUDA and three sizes)", flush=True)


def print_row(row: dict[str, Any], kernels: int) -> None:
    """One line per step, then its parts, and its costliest kernels by name."""
    line = f"{row['name']:<24} {row['size']:>10} {row['num_gaussians']:>9,} Gaussians"
    if "median_ms" in row:
        line += f" {row['median_ms']:8.2f} ms, kernels {row['kernels_ms']:.2f}, floor {row['floor_ms']:.2f}"
    if row.get("memory_mib") is not None:
        line += f", {row['memory_mib']:,.0f} MiB"
    print(line, flush=True)
    for part, found in row.get("parts", {}).items():
        if found["ms"] is not None:
            floor = f"{found['times_floor']:8.1f}x its floor" if "times_floor" in found else ""
            print(f"    {part:<20} {found['ms']:8.3f} ms {floor}", flush=True)
    for part, found in row.get("alone", {}).items():
        both = found["forward_ms"] + (found["backward_ms"] or 0.0)
        print(f"    {part:<25} {both:8.3f} ms {found['times_floor']:8.1f}x its floor, alone", flush=True)
    for kernel in row.get("kernels", [])[:kernels]:
        times = f"{kernel['microseconds']:9.1f} µs {kernel['calls']:6.1f}"
        print(f"    {times}  {kernel['part']:<20} {kernel['name'][:90]}", flush=True)


def main(words: list[str] | None = None) -> int:
    """Runs the parts asked for; returns 1 if something failed."""
    options, flags = arguments(sys.argv[1:] if words is None else words)
    prepare_host()  # as thermosplat-train does; what idle threads of torch do is settled by its import
    start_warp()
    try:
        benchmark = Benchmark(options, flags)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    for name, measure in (("whole", benchmark.whole), ("peers", benchmark.peers), ("step", benchmark.step)):
        if name in options.parts:
            with benchmark.part(name):
                measure()
    if {"step", "memory"} & set(options.parts):
        with benchmark.part("sizes"):
            benchmark.sizes()
    if "sample" in options.parts:
        with benchmark.part("sample"):
            benchmark.sample()
    report = benchmark.report
    runs = [*report.get("whole", []), report.get("sample", {})]
    failed = any("alone_error" in row for row in (*report.get("step", []), *report.get("sizes", [])))
    failed |= any("error" in row and "time limit" not in row["error"] for row in runs)
    return int(failed or bool(report["errors"]))


if __name__ == "__main__":
    sys.exit(main())
