"""Whatever ``rasterization`` is given, it renders or says in one sentence what is wrong.

THERMOSPLAT_FUZZ_CASES=5000 pytest tests/faults/test_fuzz_rasterization.py
"""

import os
import subprocess
import sys
from pathlib import Path

import rasterization_cases

CASES = int(os.environ.get("THERMOSPLAT_FUZZ_CASES", "300"))
"""As in the other tests of faults."""


def test_any_arguments() -> None:
    """In a process of its own, which may crash or hang; the message then has the last case."""
    command = [sys.executable, rasterization_cases.__file__, "--count", str(CASES)]
    allowed = 300 + CASES
    done = subprocess.run(command, capture_output=True, text=True, timeout=allowed, env=_environment())
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"{lines[-1:]}\n{done.stderr[-6000:]}"
    assert lines[-2] == f"case {CASES - 1}"
    for kind in ("UserError", "images", "differentiated"):  # else the cases would all be wrong, or all be right
        assert kind in lines[-1]


def _environment() -> dict[str, str]:
    """This process's, with its module path."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])}
