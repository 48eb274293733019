"""What a training run says: one live line on a terminal, plain lines elsewhere, metrics.jsonl and TensorBoard.

Values stay on the device until a line is due: once every ``log_every`` steps. In between, the live line counts steps
and keeps the values of the last line; on the CPU, where reading costs nothing, it shows the newest. Reading the values
leaves a GPU without work, so the line itself, a few milliseconds, is written some steps later.
"""

import io
import json
import math
import resource
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Console
from rich.live import Live
from rich.text import Text
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.printing import SafeConsole, printable
from thermosplat.runs.atomic_writes import open_to_append, write_text
from thermosplat.runs.run_directory import RunDirectory, finite_or_null
from thermosplat.runs.written_files import TENSORBOARD_SUFFIX
from thermosplat.spectra import measured_error

REFRESH_SECONDS = 0.25  # of the live line
COMPILING_AFTER_SECONDS = 3.0  # a first step that takes longer than this is compiling kernels
LATE_BY = 4
"""Steps that a GPU is given before the line of a step is written."""

_NEVER = 2**62  # steps
_METRICS = {"psnr": "PSNR {:.2f} dB", "ssim": "SSIM {:.3f}", "lpips": "LPIPS {:.3f}"}


@dataclass(frozen=True)
class StepRecord:
    """One training step, as the logger needs it."""

    step: int
    """Its number, from 1."""
    losses: dict[str, Tensor]
    """Weighted loss terms by name, scalars on the device."""
    squared_errors: dict[str, Tensor]
    """Mean squared error of the step's own images by spectrum, scalars on the device."""
    num_gaussians: int
    sh_degree: int
    """Degree of the spherical harmonics in use."""
    train_seconds: float
    """Time spent in steps so far [s]."""


class RunLogger:
    """Tells the user, metrics.jsonl and TensorBoard how the training goes.

    Args:
        run: Where the files go.
        max_steps: Steps of the whole run.
        log_every: Steps between lines.
        device: Device of the training; its memory is reported.
        tensorboard: Write TensorBoard events where tensorboard is installed.
        console: Where to print. None: standard output.
    """

    def __init__(
        self,
        run: RunDirectory,
        *,
        max_steps: int,
        log_every: int,
        device: torch.device,
        tensorboard: bool = True,
        console: Console | None = None,
    ) -> None:
        self.run = run
        self.max_steps = max_steps
        self.log_every = log_every
        self.device = device
        self.console = console if console is not None else SafeConsole(highlight=False)
        self._has_live_line = self.console.is_terminal
        self.held_out: dict[str, float] = {}
        self.scene = ""
        """Which of several scenes is trained, for lines; "" where there is one."""
        self.steps_of_others = 0
        """Steps of scenes that are still to begin."""
        self._tensorboard = tensorboard
        self._writer: Any = None
        self._live: Live | None = None
        self._sums: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}
        self._values: dict[str, float] = {}
        self._rate_from: tuple[int, float] | None = None
        self._rate = 0.0
        self._refreshed = 0.0
        self._late: StepRecord | None = None
        self._lines_lost = False

    @classmethod
    def of(cls, run: RunDirectory, config: TrainConfig, device: torch.device, *, speaks: bool) -> "RunLogger":
        """The logger of a training.

        Args:
            speaks: Whether this is the rank that tells the user; others are silent, and write nothing.
        """
        if speaks:
            every, tensorboard = config.log_every, config.tensorboard
            return cls(run, max_steps=config.max_steps, log_every=every, device=device, tensorboard=tensorboard)
        silent = SafeConsole(quiet=True, file=io.StringIO())
        return cls(run, max_steps=_NEVER, log_every=_NEVER, device=device, tensorboard=False, console=silent)

    def start(self, step: int, *, evaluates: bool = False) -> None:
        """Open the files; drop lines of metrics.jsonl from after the step that a resumed run starts from.

        Args:
            step: Steps already done; 0 for a new run.
            evaluates: The run is evaluated again at that step; a line of an earlier evaluation there is dropped, too.
        """
        path = self.run.metrics_jsonl
        if path.is_file():
            kept = [line for line in path.read_text(encoding="utf-8").splitlines() if _is_before(line, step, evaluates)]
            text = "".join(line + "\n" for line in kept)
            write_text(path, text)
        if self._tensorboard:
            try:
                from torch.utils.tensorboard import SummaryWriter

                self._writer = SummaryWriter(str(self.run.tb), purge_step=step + 1, filename_suffix=TENSORBOARD_SUFFIX)
            except ImportError:
                self.say('TensorBoard files are not written: pip install ".[tensorboard]" in the repository for them.')

    def start_again(self) -> None:
        """Drop all lines: steps count from 1 again."""
        self._report_late()
        self._sums, self._counts, self._rate_from = {}, {}, None
        if self._writer is not None:
            self._writer.close()
        self.start(0)

    def say(self, message: str) -> None:
        """Print one line above the live line."""
        line = Text(printable(message))
        self.console.print(line, soft_wrap=not self.console.is_terminal)  # a line of a log file stays one line

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """Around the first step: say what takes so long, if it does take long."""
        message = "compiling kernels (first run only, about a minute) ..."
        timer = threading.Timer(COMPILING_AFTER_SECONDS, self.say, [message])
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def step(self, record: StepRecord) -> None:
        """Take note of a step, and write a line if one is due."""
        squared_errors = {f"psnr_{spectrum}": value for spectrum, value in record.squared_errors.items()}
        values = {name: value.detach() for name, value in {**record.losses, **squared_errors}.items()}
        known = [name for name in values if name in self._sums]
        if known:  # all in one kernel
            torch._foreach_add_([self._sums[name] for name in known], [values[name] for name in known])
        for name, value in values.items():
            self._counts[name] = self._counts.get(name, 0) + 1
            if name not in known:
                self._sums[name] = value.clone()  # the next step may overwrite the value
        if self._rate_from is None:
            self._rate_from = (record.step, record.train_seconds)  # after the first step, which may have compiled
        due = record.step % self.log_every == 0 or record.step == self.max_steps
        if self._late is not None and (due or record.step >= self._late.step + LATE_BY):
            self._report_late()
        now = time.perf_counter()
        if not due and (now - self._refreshed < REFRESH_SECONDS or not self._has_live_line):
            return
        self._refreshed = now
        if due or self.device.type == "cpu":
            self._values = self._means()
        steps, seconds = record.step - self._rate_from[0], record.train_seconds - self._rate_from[1]
        if steps > 0 and seconds > 0:
            self._rate = steps / seconds
        if due:
            self._sums, self._counts = {}, {}
            self._rate_from = (record.step, record.train_seconds)
        if due and self.device.type == "cuda" and record.step < self.max_steps:
            self._late = record
        else:
            self._report(record, due=due)

    def evaluation(self, step: int, metrics: dict[str, Any]) -> None:
        """Record an evaluation on the held-out views.

        Args:
            metrics: What ``held_out.evaluate`` returned.
        """
        self._report_late()
        parts = []
        for spectrum in metrics["spectra"]:
            numbers = {name: value for name, value in (metrics[spectrum] or {}).items() if value is not None}
            if not numbers:
                continue
            if "psnr" in numbers:
                self.held_out[spectrum] = numbers["psnr"]
            parts.append(f"{spectrum} " + " ".join(_number(name, value) for name, value in numbers.items()))
            self._tensorboard_scalars(step, {f"held_out/{spectrum}_{name}": value for name, value in numbers.items()})
        self.say(f"step {step:,}: held-out views: " + "; ".join(parts or ["none"]))
        self._append({"step": step, "evaluation": metrics})

    def close(self) -> None:
        """Take the live line down and close the files. The logger cannot be used afterwards."""
        self._report_late()
        if self._live is not None:
            self._live.stop()
        self._live = None
        if self._writer is not None:
            with suppress(OSError):  # a full disk
                self._writer.close()
            self._writer = None

    def _report_late(self) -> None:
        """Write the line that waits, if one does."""
        if self._late is not None:
            record, self._late = self._late, None
            self._report(record, due=True)

    def _report(self, record: StepRecord, *, due: bool) -> None:
        """Say how far training is, and write a line to the files if one is due."""
        line = self._line(record)
        if self._has_live_line:
            self._show(line)
        else:
            self.say(line)
        if due:
            self._write(record)

    def _means(self) -> dict[str, float]:
        """Means since the last line: losses, their sum, and PSNR [dB] of the mean squared errors."""
        names = list(self._sums)
        sums = torch.stack([self._sums[name] for name in names]).tolist()
        means = {name: total / self._counts[name] for name, total in zip(names, sums)}
        for name in [name for name in names if name.startswith("psnr_")]:
            means[name] = -10.0 * math.log10(means[name]) if means[name] > 0 else math.inf
        loss = sum(value for name, value in means.items() if not name.startswith("psnr_"))
        return {"loss": loss, **means}

    def _line(self, record: StepRecord) -> str:
        parts = [f"{self.scene}step {record.step:,}/{self.max_steps:,}"]
        if self._rate > 0:
            eta = (self.max_steps - record.step + self.steps_of_others) / self._rate
            parts.append(f"{self._rate:.1f} it/s  ETA {duration(eta)}")
        for name in [name for name in self._values if name.startswith("psnr_")]:
            spectrum = name.removeprefix("psnr_")
            held_out = f" (held-out {self.held_out[spectrum]:.2f})" if spectrum in self.held_out else ""
            parts.append(f"{spectrum} {self._values[name]:.2f} dB{held_out}")
        parts.append(f"{record.num_gaussians:,} Gaussians  {memory_bytes(self.device) / 2**30:.1f} GiB")
        if self._values:
            terms = " ".join(
                f"{name} {value:.4f}" for name, value in self._values.items() if not name.startswith("psnr_")
            )
            parts.append(terms)  # last, because a narrow terminal cuts the line off
        return "  ".join(parts)

    def _show(self, line: str) -> None:
        text = Text(line, no_wrap=True, overflow="ellipsis")
        if self._live is None:
            self._live = Live(text, console=self.console, auto_refresh=False)
            self._live.start()
        self._live.update(text, refresh=True)

    def _write(self, record: StepRecord) -> None:
        entry = {
            "step": record.step,
            **self._values,
            "num_gaussians": record.num_gaussians,
            "sh_degree": record.sh_degree,
            "train_seconds": record.train_seconds,
            "memory_bytes": memory_bytes(self.device),
        }
        self._append(entry)
        self._tensorboard_scalars(
            record.step, {f"train/{name}": value for name, value in entry.items() if name != "step"}
        )

    def _append(self, entry: dict[str, Any]) -> None:
        path = self.run.metrics_jsonl
        try:
            with open_to_append(path) as file:
                file.write((json.dumps(finite_or_null(entry), allow_nan=False) + "\n").encode())
        except OSError as error:  # a full disk: a line less, which costs no training
            if not self._lines_lost:
                self.say(f"Could not write {path}: {error.strerror or error}. Training goes on without its line.")
            self._lines_lost = True

    def _tensorboard_scalars(self, step: int, scalars: dict[str, float]) -> None:
        if self._writer is None:
            return
        try:
            for name, value in scalars.items():
                self._writer.add_scalar(name, value, step)
        except OSError as error:  # of its own thread, which has ended
            self._writer = None
            self.say(f"TensorBoard files are written no further: {error.strerror or error}.")


def memory_bytes(device: torch.device) -> int:
    """Peak memory: torch's on the GPU, the process's on the CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # Linux counts in KiB


def duration(seconds: float) -> str:
    """A duration as 1:02:03 or 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _number(name: str, value: float) -> str:
    """A metric for people: "PSNR 24.31 dB", "MAE 0.42 °C", "bias -0.0085 reflectance"."""
    if name in _METRICS:
        return _METRICS[name].format(value)
    digits = ".2f" if abs(value) >= 0.1 else ".2g"
    error = measured_error(name)
    if error is None:
        return f"{name.replace('_', ' ')} {value:{digits}}"
    return f"{error.heading} {value:{error.sign}{digits}} {error.unit}"


def _is_before(line: str, step: int, evaluates: bool) -> bool:
    """Whether a line of metrics.jsonl is of steps that are not done again; one that a crash cut off is not."""
    try:
        entry = json.loads(line)
        return entry["step"] < step or (entry["step"] == step and not (evaluates and "evaluation" in entry))
    except (ValueError, KeyError, TypeError):
        return False
