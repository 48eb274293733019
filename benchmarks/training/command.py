"""thermosplat-train from a benchmark: its flags on the benchmark's command line, and processes that run it."""

import math
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import thermosplat
import warp_kernels


def apart(words: list[str]) -> tuple[list[str], list[str]]:
    """A benchmark's own words, and the flags of thermosplat-train after ``--``."""
    if "--" not in words:
        return words, []
    place = words.index("--")
    return words[:place], words[place + 1 :]


def run_python(
    arguments: Sequence[str], environment: Mapping[str, str], limit_s: float = math.inf
) -> "subprocess.CompletedProcess[str]":
    """Runs this Python with the packages that the benchmark itself has, and with no file of the current folder.

    Args:
        arguments: of Python.
        environment: beside the process's own, PYTHONPATH left out.
        limit_s: it is stopped after so long [s].

    Raises:
        subprocess.TimeoutExpired: it was stopped.
    """
    roots = [str(Path(str(module.__file__)).parents[1]) for module in (thermosplat, warp_kernels)]
    path = os.pathsep.join([*roots, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(
        [sys.executable, "-P", *arguments],
        env=os.environ | dict(environment) | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=None if math.isinf(limit_s) else limit_s,
    )


def failure(done: "subprocess.CompletedProcess[str]") -> str:
    """The end of what a failed process wrote; empty where it did not fail."""
    return "" if done.returncode == 0 else (done.stderr or done.stdout).strip()[-500:] or f"exit {done.returncode}"
