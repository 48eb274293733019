"""Whatever ``rasterization`` is given, it renders or says in one sentence what is wrong.

THERMOSPLAT_FUZZ_CASES=5000 pytest tests/faults/test_fuzz_rasterization.py
"""

import os

import pytest

import rasterization_cases
from forked_processes import run_python

CASES = int(os.environ.get("THERMOSPLAT_FUZZ_CASES", "300"))
"""As in the other tests of faults."""


@pytest.mark.rotating("fuzzed input")
def test_any_arguments() -> None:
    """In a process of its own, which may crash or hang; the message then has the last case."""
    done = run_python(rasterization_cases.__file__, "--count", str(CASES), seconds=300 + CASES)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"{lines[-1:]}\n{done.stderr[-6000:]}"
    assert lines[-2] == f"case {CASES - 1}"
    for kind in ("UserError", "images", "differentiated"):  # else the cases would all be wrong, or all be right
        assert kind in lines[-1]
