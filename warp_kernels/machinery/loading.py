"""Making, compiling and loading kernels, one thread after the other.

A module that two threads load at the same time is loaded twice, and Warp unloads the first copy while its thread may
already run it: a segmentation fault. So what is done for a kernel for the first time is done under one lock. Whoever
uses a kernel again takes no lock.
"""

import functools
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from typing import ParamSpec, TypeVar

import warp as wp

from warp_kernels.machinery.stored_modules import StoredModule

Arguments = ParamSpec("Arguments")
Made = TypeVar("Made")

SLOW = 1.0
"""Time after which compiling is told [s]."""

QUIET = 30.0
"""Time for which nothing is told again [s]: a program that is new to a machine compiles many kernels in a row."""

one_at_a_time = threading.RLock()
"""Held while a kernel is made, compiled or loaded."""

_loaded: set[tuple[wp.Kernel, str, int]] = set()


class KernelCacheError(OSError):
    """Warp's folder for compiled kernels cannot be used; the text says which file, and why."""


def made_once(make: Callable[Arguments, Made]) -> Callable[Arguments, Made]:
    """As ``functools.cache``, for what makes kernels and their functions: threads that need the same get the same.

    Returns:
        A function that makes it when it is first asked for it.
    """
    inner = functools.cache(make)

    @functools.cache
    @functools.wraps(make)
    def made(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Made:
        with one_at_a_time:
            return inner(*args, **kwargs)

    return made  # type: ignore[return-value]


def start() -> None:
    """Initialises Warp, once.

    Raises:
        KernelCacheError: if the folder for compiled kernels cannot be made.
    """
    with one_at_a_time, _cache_errors():
        wp.init()


@contextmanager
def first_use(kernel: wp.Kernel, device: wp.Device, block: int) -> Iterator[None]:
    """Around the first launch of a kernel by a thread: loads it if no thread has, while no other thread loads anything.

    Raises:
        KernelCacheError: if the folder for compiled kernels cannot be read or written.
    """
    use = (kernel, device.alias, block)
    if use in _loaded:
        yield
        return
    with one_at_a_time, _cache_errors():
        stored = StoredModule.of(kernel, device, block)
        with nullcontext() if stored.is_whole() else _told_if_slow(kernel), stored.loaded():
            yield
        _loaded.add(use)


def must_compile(kernels: list[wp.Kernel], device: wp.Device) -> bool:
    """Whether Warp's cache lacks one of them.

    Args:
        kernels: launched on the CPU, or on CUDA with the block of their module.
    """
    with one_at_a_time, _cache_errors():
        stored = {StoredModule.of(kernel, device, kernel.module.options["block_dim"]) for kernel in kernels}
        return not all(module.is_whole() for module in stored)


def load_for_cpu(kernels: list[wp.Kernel], workers: int) -> None:
    """Loads kernels side by side, which is safe for modules that differ.

    Raises:
        KernelCacheError: if the folder for compiled kernels cannot be read or written.
    """
    modules = list({kernel.module.name: kernel.module for kernel in kernels}.values())
    with one_at_a_time, _cache_errors(), ExitStack() as stored:
        for module in sorted({StoredModule.of(kernel, wp.get_device("cpu"), 1) for kernel in kernels}):
            stored.enter_context(module.loaded())
        wp.force_load("cpu", modules, block_dim=1, max_workers=workers)


@contextmanager
def _cache_errors() -> Iterator[None]:
    """Tells errors of Warp's cache from others."""
    try:
        yield
    except OSError as error:
        place = error.filename or wp.config.kernel_cache_dir
        raise KernelCacheError(f"{error.strerror or error} ({place})") from error


@contextmanager
def _told_if_slow(kernel: wp.Kernel) -> Iterator[None]:
    """Says that a kernel is compiled when that takes long."""
    timer = threading.Timer(SLOW, _tell, [kernel.key])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _tell(name: str) -> None:
    global _quiet_until
    now = time.monotonic()
    if now < _quiet_until:
        return
    _quiet_until = now + QUIET
    print(f"Compiling kernels, once per machine (now {name}) ...", file=sys.stderr, flush=True)


_quiet_until = 0.0


# A forked process has the forking thread alone: nothing is half loaded when it begins.
if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(
        before=one_at_a_time.acquire,
        after_in_parent=one_at_a_time.release,
        after_in_child=one_at_a_time.release,
    )
