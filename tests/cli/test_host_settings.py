"""What a training process asks of the C library: memory that is freed can be had again without page faults."""

import gc
import importlib
import os
import platform
import resource
import signal
import subprocess
import sys
from collections.abc import Mapping

import pytest

from thermosplat.cli.host_settings import WITH_TORCH, WITHOUT_TORCH, importing, without_garbage_collection
from thermosplat.errors import UserError

pytestmark = pytest.mark.usefixtures("stoppable")

ROUNDS = """
import os, resource
import numpy as np
from thermosplat.cli.host_settings import prepare_host

prepare_host()

def round():
    return [np.ones(2**size, np.float32) for size in (21, 21, 21, 24, 24)]  # 8 and 64 MiB

round(), round()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    round()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before, os.environ["GOMP_SPINCOUNT"])
"""
PAGES = 10 * (3 * 2**23 + 2 * 2**26) // os.sysconf("SC_PAGE_SIZE")
"""Of all arrays of the counted rounds."""


def faults_and_spins(environment: Mapping[str, str]) -> tuple[int, str]:
    path = os.pathsep.join(filter(None, sys.path))
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GOMP_", "GLIBC_"))}
    # small pages alone: the number of faults must not depend on what the system makes of large arrays
    done = subprocess.run(
        [sys.executable, "-c", ROUNDS],
        env=clean | {"PYTHONPATH": path, "NUMPY_MADVISE_HUGEPAGE": "0"} | dict(environment),
        capture_output=True,
        text=True,
        check=True,
    )
    faults, spins = done.stdout.split()
    return int(faults), spins


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_freed_memory_is_kept() -> None:
    """Arrays that come and go are not filled with fresh pages every time."""
    assert faults_and_spins({})[0] < 0.1 * PAGES


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_the_environment_has_the_last_word() -> None:
    """Who sets the thresholds or the spinning themselves gets them."""
    faults, spins = faults_and_spins({"MALLOC_TRIM_THRESHOLD_": "131072", "GOMP_SPINCOUNT": "7"})
    assert faults > faults_and_spins({})[0] + 10 * 5  # at least one for every array
    assert spins == "7"


def test_garbage_is_collected_again_after_imports() -> None:
    """Also after an import that failed, and not where the user had switched collection off."""
    with importing():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ModuleNotFoundError), importing():
        importlib.import_module("thermosplat.not_there")
    assert gc.isenabled()
    gc.disable()
    try:
        with without_garbage_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_ctrl_c_waits_for_the_end_of_an_import() -> None:
    """It comes at the end of the block, and is not lost."""
    imported = []
    with pytest.raises(KeyboardInterrupt), importing():  # noqa: PT012  it comes at the block's end
        os.kill(os.getpid(), signal.SIGINT)
        imported.append(True)
    assert imported
    assert gc.isenabled()


@pytest.mark.parametrize(("limit", "least"), [(WITH_TORCH - 1, WITH_TORCH), (10**6, WITHOUT_TORCH), (None, WITH_TORCH)])
def test_too_little_address_space_is_told(limit: int | None, least: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before libraries are loaded, which would fail one way or another (``ulimit -v``)."""
    soft = resource.RLIM_INFINITY if limit is None else limit
    monkeypatch.setattr(resource, "getrlimit", lambda _: (soft, resource.RLIM_INFINITY))
    if limit is None:
        with importing(least):
            return
    said = "GiB of address space, and the libraries alone take up to"
    with pytest.raises(UserError, match=said) as caught, importing(least):
        pass
    assert "ulimit -v unlimited" in caught.value.hint
