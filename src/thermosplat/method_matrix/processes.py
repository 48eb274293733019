"""Cells in processes of their own, one at a time on each device.

One process per cell keeps them apart: what one leaves on the GPU, or breaks, is gone with it, and the peak of its
memory is its own. Ctrl-C, SIGTERM and SIGHUP are handed on to the processes as SIGTERM; each saves a checkpoint, so
that the same command goes on.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import open_to_append
from thermosplat.stop_signals import stopped_by_signals

POLL_SECONDS = 0.2


@dataclass(frozen=True)
class Job:
    """One process to run."""

    title: str
    command: Sequence[str]
    log: Path
    """Where its output goes, at the end of what is there."""

    def reason(self, code: int) -> str:
        """Why it failed: the signal that ended it, or else the last line that it wrote.

        Args:
            code: Its exit code, as ``subprocess`` has it.
        """
        if code < 0:
            return f"ended by {signal.Signals(-code).name}"
        try:
            lines = self.log.read_text(encoding="utf-8", errors="replace").split("\n")
        except OSError:
            lines = []
        last = next((line.strip() for line in reversed(lines) if line.strip()), "it wrote nothing")
        return last.removeprefix("Error: ")


@dataclass(frozen=True)
class _Running:
    job: Job
    process: "subprocess.Popen[bytes]"


def choose_devices(asked: Sequence[str], gpus: int | None = None) -> list[str]:
    """The devices of a command line.

    Args:
        asked: "cpu", "cuda" or "cuda:<index>"; none: every CUDA device, or the CPU where there is none.
        gpus: So many CUDA devices in place of every one.

    Raises:
        UserError: A device that is not there, or is named twice.
    """
    if asked and gpus is not None:
        raise UserError("--gpus counts devices and --devices names them.", "Give one of the two.")
    if not asked:
        import torch

        if gpus is not None:
            seen = torch.cuda.device_count()
            if not 1 <= gpus <= seen:
                raise UserError(f"--gpus {gpus}, but this process sees {seen} CUDA devices.", "Or leave --gpus out.")
            return [f"cuda:{index}" for index in range(gpus)]
        return [f"cuda:{index}" for index in range(torch.cuda.device_count())] or ["cpu"]
    from thermosplat.runs.devices import choose_device

    devices = [str(choose_device(name)) for name in asked]
    if len(set(devices)) < len(devices):
        raise UserError(f"--devices names a device twice: {' '.join(asked)}.", "Each takes one cell at a time.")
    return devices


def run_jobs(
    jobs: Sequence[Job],
    devices: Sequence[str],
    *,
    started: Callable[[Job, str], None],
    done: Callable[[Job, str, int], None],
    time_limit: float | None = None,
) -> list[Job]:
    """Run all jobs, whatever becomes of each.

    Args:
        jobs: The jobs, in order.
        devices: "cpu" or "cuda:<index>", each of which takes one job at a time.
        started: Called with a job and its device when it starts.
        done: Called with a finished job, its device and its exit code.
        time_limit: Seconds from now after which no job starts; those that run then run to their end.

    Raises:
        KeyboardInterrupt: After Ctrl-C, SIGTERM or SIGHUP, when all processes have ended.
    """
    waiting, running, began = list(jobs), dict[str, _Running](), time.monotonic()
    left: list[Job] = []
    with stopped_by_signals():
        try:
            while waiting or running:
                if time_limit is not None and time.monotonic() - began >= time_limit:
                    left, waiting = left + waiting, []
                for device in devices:
                    if device not in running and waiting:
                        job = waiting.pop(0)
                        running[device] = _start(job, device_environment(device, sharing=len(devices)))
                        started(job, device)
                time.sleep(POLL_SECONDS)
                for device, current in list(running.items()):
                    code = current.process.poll()
                    if code is not None:
                        del running[device]
                        done(current.job, device, code)
        except BaseException:  # also an error in a callback: no process outlives this one
            for current in running.values():
                current.process.terminate()  # a process in a script's background ignores SIGINT
            for current in running.values():
                current.process.wait()
            raise
    return left


def device_environment(device: str, *, sharing: int = 1) -> dict[str, str]:
    """Environment in which the given device is the only one.

    Args:
        device: "cpu" or "cuda:<index>"; the index counts among the devices that this process sees.
        sharing: How many processes run at a time; they get a share of the CPU's cores each, unless OMP_NUM_THREADS
            says otherwise.
    """
    environment = dict(os.environ)
    if sharing > 1:
        environment.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 1) // sharing)))
    if device == "cpu":
        environment["CUDA_VISIBLE_DEVICES"] = ""
    else:
        index = int(device.removeprefix("cuda:"))
        seen = environment.get("CUDA_VISIBLE_DEVICES")
        environment["CUDA_VISIBLE_DEVICES"] = seen.split(",")[index] if seen else str(index)
    return environment


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module of this installation, whatever Python files lie in the current folder."""
    return [sys.executable, "-P", "-m", module, *arguments]


def _start(job: Job, environment: dict[str, str]) -> _Running:
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with open_to_append(job.log) as log:
        process = subprocess.Popen(
            job.command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,  # Ctrl-C reaches it once, from here
        )
    return _Running(job, process)
