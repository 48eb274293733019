"""What a training process asks of the C library, OpenMP and Python: memory and cores for thousands of equal steps.

Nothing of it changes a result. On two cores memory and spinning take a fifth off a step of ``thermosplat-train
sample``, as benchmarks/notes/cpu.md has it.
"""

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from thermosplat.errors import UserError
from thermosplat.stop_signals import deferred_interrupts

KEPT_BYTES = 2**31 - 1
"""Freed memory that stays with the process; the largest number that ``mallopt`` takes."""

SPIN_COUNT = "30000"
"""How often an idle OpenMP thread looks for work before it sleeps, about a millisecond. libgomp's 300,000 keep a core
from the renderer's threads through much of their turn."""

WITH_TORCH, WITHOUT_TORCH = 3 << 30, 3 << 29
"""Address space [bytes] that a command needs which imports torch and Warp, or only OpenCV and pycolmap. On two cores
they take 2.2 and 0.9 GB; the stacks of threads on more cores come to that."""

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # malloc.h


def prepare_host() -> None:
    """Keep memory between steps, and let idle threads of torch sleep soon. To be called before torch is imported.

    With glibc's defaults every large tensor is given back to the system when it is freed, and the next step's has to be
    filled with zeros page by page again.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", SPIN_COUNT)
    if sys.platform == "linux" and "MALLOC_TRIM_THRESHOLD_" not in os.environ:
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_M_MMAP_MAX, 0)  # no tensor, however large, from the system one by one
            mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES)


def allowed_memory() -> int | None:
    """Bytes of address space that this process may have (``ulimit -v``); None: any number."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit


@contextmanager
def importing(least: int = WITH_TORCH) -> Iterator[None]:
    """Around imports: they are quicker, and Ctrl-C waits for their end.

    An interrupt in the middle of an import comes out of C++ as some other error than an interrupt.

    Args:
        least: Bytes of address space without which the libraries fail one way or another, some with a crash.

    Raises:
        UserError: This process may have fewer.
    """
    limit = allowed_memory()
    if limit is not None and limit < least:
        raise UserError(
            f"This process may have {limit / 2**30:.1f} GiB of address space, and the libraries alone take up to "
            f"{least / 2**30:.1f}.",
            "Let it have more: ulimit -v unlimited",
        )
    with deferred_interrupts(), without_garbage_collection():
        yield


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Around imports, and what is done while they go on: no garbage is looked for.

    Torch and what it brings make some 400,000 objects that all stay; to go through them again and again takes a fifth
    of the time.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
