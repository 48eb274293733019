"""Fixtures every test folder may use."""

import os
import signal
from collections import defaultdict
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import Any
from zlib import crc32

import pytest
import torch

from gsplat_reference import installed

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """With ``-n``, there are processes for all cores: each has one thread, and so has what it starts; and all have the
    same day."""
    os.environ.setdefault("THERMOSPLAT_QUARTER", str(date.today().toordinal() % 4))
    if hasattr(config, "workerinput"):
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        torch.set_num_threads(1)


def pytest_report_header() -> str:
    """How to see today's choice of cases again."""
    return f"rotating cases: THERMOSPLAT_QUARTER={os.environ['THERMOSPLAT_QUARTER']}"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A quarter of the cases of each test that is marked ``rotating``, or of all tests of one family that is named
    there: another one every day and one at least; the others are ``slow``. Those on CUDA stay."""
    quarter, families = os.environ["THERMOSPLAT_QUARTER"], defaultdict(list)
    if quarter == "all":
        return
    for item in items:
        mark = item.get_closest_marker("rotating")
        if mark is not None and not {"cuda", "slow"} & {other.name for other in item.iter_markers()}:
            families[mark.args[0] if mark.args else item.nodeid.partition("[")[0]].append(item)
    for family in families.values():
        family.sort(key=lambda item: crc32(item.nodeid.encode()))
        for number, item in enumerate(family):
            if (number - int(quarter)) % min(4, len(family)) != 0:
                item.add_marker("slow")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests that are marked ``cuda`` are skipped where there is no device, before their fixtures want one. With
    ``-n``, each test begins with one thread: numba, by which others read our files, gives OpenMP as many as cores."""
    if hasattr(item.config, "workerinput"):
        torch.set_num_threads(1)
    if item.get_closest_marker("cuda") is not None and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device; torch finds none")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Each device the renderer runs on; the CUDA half is marked ``cuda``."""
    return torch.device(request.param)


@pytest.fixture
def stoppable() -> Iterator[None]:
    """Signals stop this process and what it starts, also where who started it has some ignored or blocked, as under
    nohup, behind a shell's ``&`` or in a service."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    ignored = [number for number in usual if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, usual[number])
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, usual)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)


@pytest.fixture
def gsplat_reference() -> Iterator[Callable[..., Any]]:
    """gsplat 1.5.3's own torch reference of ``rasterization``, in float64 on the CPU."""
    pytest.importorskip("gsplat", reason="gsplat 1.5.3 is not installed (pip install --no-deps gsplat==1.5.3)")
    default_dtype = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with installed() as reference:
            yield reference
    finally:
        torch.set_default_dtype(default_dtype)
