"""How long does a training take, where does a step go, and what would gsplat's rasterizer make of it?

    python benchmarks/bench_training.py DATA --json training.json --markdown training.md -- --max-steps 7000
    python benchmarks/bench_training.py sample --device cpu --json training.json

Flags behind -- go to thermosplat-train. Parts (--parts), in this order:

whole   DATA trained by thermosplat-train in a process of its own: seconds to metrics.json, held-out PSNR, memory.
peers   Steps from one checkpoint in windows that take turns: ours, gsplat called twice, gsplat and ours on RGB alone.
step    Where a step goes, part by part, with the floor of each, on DATA and on random Gaussians; memory.
sample  thermosplat-train sample on the CPU, with nothing compiled before.

The files are rewritten after every measurement. README.md says what is measured, and how.
"""

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2  # noqa: F401  (before pycolmap: see docs/troubleshooting.md)
import torch
from device_peaks import DevicePeaks, measure_peaks
from gsplat_rgbt_adapter import find_gsplat
from steady_training import quiet_trainer, run_steps
from training_bench_arguments import parse
from training_peers import compare_steps
from training_runs import differences, training_run, whole_runs
from training_step_case import memory_model, random_case, step_case
from training_tables import lines_of, markdown

from thermosplat.checkpoint import write_atomically
from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.warp_start import start_warp
from thermosplat.config import TrainConfig
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.devices import choose_device
from thermosplat.run_directory import RunDirectory, environment, finite_or_null
from thermosplat.training.resuming import check_resumable, newest_checkpoint


class TimeIsUp(Exception):
    """The time limit came; the message says before what."""


class TrainingBenchmark:
    """One run of the benchmark.

    Args:
        options: Command line.
        folder: Where trainings go.
    """

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.options = options
        self.folder = folder
        self.device = choose_device(options.device)
        self.report: dict[str, Any] = {"environment": self._environment()}
        self._started = time.perf_counter()

    def run(self) -> int:
        """Measures part after part; returns 1 if any failed or found a disagreement."""
        parts: dict[str, Callable[[], None]] = {
            "whole": self.whole,
            "peers": self.peers,
            "step": self.step,
            "sample": self.sample,
        }
        failed = False
        for name in (name for name in parts if name in self.options.parts and "stopped" not in self.report):
            try:
                parts[name]()
            except TimeIsUp as limit:
                self.report["stopped"] = str(limit)
                print(limit, flush=True)
            except Exception as error:  # a part that fails must not lose the others
                traceback.print_exc()
                self.report.setdefault(name, {})["error"] = f"{type(error).__name__}: {error}"
                failed = True
            finally:
                self.write()
            if name in self.report:
                print("\n".join(lines_of(self.report, name)) + "\n", flush=True)
        disagreement = self.report.get("peers", {}).get("disagreement")
        made = [run for part in ("whole", "sample") for run in self.report.get(part, {}).get("runs", [])]
        made += self.report.get("step", {}).get("cases", [])
        failed |= any("error" in one or "parts_error" in one for one in made)
        return int(failed or disagreement is not None)

    def whole(self) -> None:
        """DATA by the command."""
        options, part = self.options, self.report.setdefault("whole", {"runs": []})
        variants = ["default", *(name for name in ("plain", "deterministic") if getattr(options, name))]
        flags = [*self._flags, "--device", options.device]
        runs = whole_runs(options.data, flags, options.seeds, variants, self.folder)
        for run in self._in_time(runs, "a training of DATA"):
            part["runs"].append(run)
            part["differences"] = differences(part["runs"])
            self.write()

    def peers(self) -> None:
        """Steps side by side."""
        options = self.options
        self._check_time("the steps side by side")
        gsplat = None if options.no_gsplat else find_gsplat(self.device, options.oracle)
        self.report["peers"] = compare_steps(
            self.config,
            self.capture,
            self.checkpoint,
            gsplat,
            rounds=options.windows,
            window=options.window,
            with_plain=options.plain,
        )

    def step(self) -> None:
        """Where a step goes."""
        options = self.options
        part = self.report.setdefault("step", {"cases": [], "memory_model": None})
        if not options.no_data_case:
            self._check_time("a step on DATA")
            times = (options.step_window, options.repeats)
            case = step_case(self.config, self.capture, self.peaks, *times, checkpoint=self.checkpoint)
            self._note_case(case)
        random_cases = []
        for size in options.sizes:
            width, height = (int(number) for number in size.lower().split("x"))
            for count in options.counts:
                self._check_time(f"a step on {count:,} random Gaussians at {size}")
                case = random_case(
                    self.config, (width, height), count, self.peaks, options.step_window, options.repeats
                )
                random_cases.append(case)
                part["memory_model"] = memory_model(random_cases)
                self._note_case(case)

    def sample(self) -> None:
        """The packaged capture on the CPU."""
        options = self.options
        self._check_time("thermosplat-train sample")
        cache = None if options.warm_cache else self.folder / "kernels"
        flags = [*self.options.flags, "--device", "cpu"]
        run = training_run("sample", flags, self.folder / "sample", cores=options.cores, kernel_cache=cache)
        run |= {"cores": options.cores, "kernel_cache": "warm" if options.warm_cache else "empty"}
        self.report["sample"] = {"runs": [run]}

    # ---- what the parts share ----------------------------------------------------------------------------------------

    @property
    def _flags(self) -> list[str]:
        """What thermosplat-train is told in every part but ``sample``."""
        preset = [] if self.options.config is None else ["--config", self.options.config]
        return [*preset, *self.options.flags]

    @cached_property
    def config(self) -> TrainConfig:
        """The configuration of these flags."""
        return parse_train_arguments([self.options.data, *self._flags, "--device", self.options.device])

    @cached_property
    def capture(self) -> Capture:
        """DATA."""
        config = self.config
        options = {"data_factor": config.data_factor, "test_every": config.test_every, "thermal": config.thermal}
        return load_capture(config.data, **options)

    @cached_property
    def peaks(self) -> DevicePeaks:
        """Measured when they are first needed."""
        peaks = measure_peaks(self.device)
        self.report["peaks"] = peaks._asdict()
        return peaks

    @cached_property
    def checkpoint(self) -> dict[str, Any]:
        """Trained Gaussians: of --run, or of the first whole training of this run, or of a short training."""
        run = self.options.run or next(
            (run["folder"] for run in self.report.get("whole", {}).get("runs", []) if "error" not in run), None
        )
        if run is not None:
            directory = RunDirectory.open(run)
            checkpoint = newest_checkpoint(directory)
            check_resumable(checkpoint, self.config, directory)
            return checkpoint
        trainer = quiet_trainer(self.config, self.capture, self.folder / "start")
        run_steps(trainer, self.options.start_steps)
        trainer._save()
        return newest_checkpoint(trainer.run)

    def _in_time(self, runs: Iterator[dict[str, Any]], what: str) -> Iterator[dict[str, Any]]:
        while True:
            self._check_time(what)
            run = next(runs, None)
            if run is None:
                return
            yield run

    def _check_time(self, what: str) -> None:
        limit = self.options.time_limit
        if limit is not None and time.perf_counter() - self._started > limit:
            raise TimeIsUp(f"The time limit of {limit:g} s came before {what}.")

    def _note_case(self, case: dict[str, Any]) -> None:
        self.report["step"]["cases"].append(case)
        self.write()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def write(self) -> None:
        """Replaces the files, so that they are whole at any time."""
        self.report["seconds"] = time.perf_counter() - self._started
        report = finite_or_null(self.report)
        for path, text in (
            (self.options.json, json.dumps(report, indent=1) + "\n"),
            (self.options.markdown, markdown(report)),
        ):
            if path is not None:
                write_atomically(path, lambda temporary, text=text: temporary.write_text(text, encoding="utf-8"))

    def _environment(self) -> dict[str, Any]:
        try:
            gsplat = version("gsplat")
        except PackageNotFoundError:
            gsplat = None
        return {
            "command": " ".join(["python", "benchmarks/bench_training.py", *self.options.words]),
            "date": time.strftime("%Y-%m-%d"),
            **environment(self.device),
            "gsplat": gsplat,
        }


def main(words: list[str] | None = None) -> int:
    """Runs the parts asked for; returns 1 if any failed or found a disagreement.

    Args:
        words: Command line; None: the process's own.
    """
    options = parse(__doc__ or "", words)
    start_warp()
    with TemporaryDirectory() as temporary:
        return TrainingBenchmark(options, options.out or Path(temporary)).run()


if __name__ == "__main__":
    sys.exit(main())
