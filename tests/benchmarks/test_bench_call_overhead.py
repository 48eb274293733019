"""What a plain call costs the host, counted: a call that grows heavier is seen here and not on a GPU months later."""

from pathlib import Path

import pytest
import torch

import thermosplat
import warp_kernels
from bench_call_overhead import called, passes, table
from benchmark_scripts import run_script

OWN = tuple(str(Path(package.__path__[0])) for package in (thermosplat, warp_kernels))
"""Where the functions lie that are counted, installed or in the tree."""

MOST = {"rgb, forward": 205, "rgb, with backward": 340, "rgbt, forward": 215, "rgbt, with backward": 360}
"""Calls of this repository's Python functions, of which Python 3.11 makes the most; a tenth above what was counted."""


@pytest.mark.parametrize("name", list(MOST))
def test_a_plain_call_calls_few_functions(name: str) -> None:
    """Checks of arguments, saved state, arrays and launches stay as light as they are."""
    python, builtin = called(passes()[name])
    own = {function: count for function, count in python.items() if function.startswith(OWN)}
    assert any("api.py" in function or "rgbt.py" in function for function in own)
    assert sum(own.values()) <= MOST[name], sorted(own.items(), key=lambda item: -item[1])[:20]
    assert sum(builtin.values()) > 0


@pytest.mark.parametrize("name", [name for name in MOST if name.endswith("forward")])
@pytest.mark.parametrize("recorded", [False, True])
def test_a_plain_call_enters_few_files(name: str, recorded: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """At most ten on the way to the kernels' steps, whether gradients are wanted or not, and ten of warp_kernels."""
    if recorded:
        monkeypatch.setattr(torch, "no_grad", torch.enable_grad)
    python, _ = called(passes()[name])
    files = {function.rsplit(":", 1)[0] for function in python if function.startswith(OWN)}
    of_kernels = {file for file in files if file.startswith(OWN[1])}
    assert 0 < len(files - of_kernels) <= 10, sorted(files - of_kernels)
    assert 0 < len(of_kernels) <= 10, sorted(of_kernels)


def test_functions_are_counted() -> None:
    """Those of Python by their name, and those that are built in, apart."""

    def inner() -> int:
        return len("ab")

    def outer() -> int:
        return inner() + inner()

    python, builtin = called(outer)
    assert {name.split()[-1].split(".")[-1]: count for name, count in python.items()} == {"outer": 1, "inner": 2}
    assert builtin["<built-in method builtins.len>"] == 2


def test_trees_are_compared_by_turns() -> None:
    """The ratio is that of neighbouring turns, so that a load that comes and goes is in none of them."""
    counts = {"forward": {"python": {"a": 3}, "builtin": {"b": 2}}}
    mine, theirs = [1.0, 2.0, 4.0], [2.0, 4.0, 8.0]
    found = {
        name: {"calls": counts, "times": {"forward": {"wall": times, "own": times}}}
        for name, times in (("this", mine), ("before", theirs))
    }
    assert "| | ratio | 1.00 | 1.00 | 0.500 ± 0.000 | 0.500 ± 0.000 |" in table(found)
    assert "| forward | before | 3 | 2 | 4.000 | 4.000 |" in table(found)


def test_the_script_runs() -> None:
    """A process of its own measures the tree, and the functions that are called most are named."""
    done = run_script("bench_call_overhead.py", "--turns", "2", "--functions", "3")
    assert done.returncode == 0, done.stdout + done.stderr
    assert all(name in done.stdout for name in MOST)
    assert "_struct.Struct" in done.stdout
