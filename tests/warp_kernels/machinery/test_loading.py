"""Kernels are made and loaded once, whoever asks; what takes long is told, and what cannot be read too."""

import errno
import threading
import time
from pathlib import Path

import pytest
import warp as wp

from forked_processes import run_python
from fresh_kernels import fresh_kernel
from warp_kernels.machinery import loading
from warp_kernels.machinery.launching import launch
from warp_kernels.machinery.loading import KernelCacheError, first_use, made_once, must_compile
from warp_kernels.machinery.stored_modules import StoredModule


@wp.kernel(enable_backward=False, module="unique")
def double_kernel(first: int, values: wp.array(dtype=wp.float32)):
    """Doubles each value."""
    i = wp.tid() + first
    values[i] = values[i] * 2.0


@wp.kernel(enable_backward=False, module="unique")
def triple_kernel(first: int, values: wp.array(dtype=wp.float32)):
    """Multiplies each value by three."""
    i = wp.tid() + first
    values[i] = values[i] * 3.0


def in_threads(count: int, run: object) -> None:
    """Calls a function from several threads at once."""
    together = threading.Barrier(count)

    def call() -> None:
        together.wait()
        run()

    threads = [threading.Thread(target=call) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_threads_make_a_thing_once() -> None:
    """All get the same object, also those that ask while it is made; other arguments make another."""
    made = []

    @made_once
    def thing(number: int) -> object:
        time.sleep(0.01)
        made.append(number)
        return object()

    found = []
    in_threads(8, lambda: found.append(thing(3)))
    assert made == [3]
    assert len(found) == 8
    assert len(set(map(id, found))) == 1
    assert thing(4) is not found[0]


def test_a_module_is_loaded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the first of several threads, whose copy of the code stays the one."""
    device = wp.get_device("cpu")
    loads = []
    original = type(double_kernel.module).load

    def load(module: object, *arguments: object, **named: object) -> object:
        before = dict(module.execs)
        found = original(module, *arguments, **named)
        if dict(module.execs) != before:
            loads.append(found)
        return found

    monkeypatch.setattr(type(double_kernel.module), "load", load)
    arrays = [wp.ones(4, dtype=wp.float32, device="cpu") for _ in range(8)]
    free = list(arrays)
    in_threads(8, lambda: launch(double_kernel, 4, [free.pop()], device))
    assert len(loads) == 1
    assert all((array.numpy() == 2).all() for array in arrays)


def test_loaded_kernels_take_no_lock() -> None:
    """A thread that compiles does not stop others that launch, for the first time too, what is loaded."""
    device = wp.get_device("cpu")
    array = wp.ones(4, dtype=wp.float32, device="cpu")
    launch(triple_kernel, 4, [array], device)
    with loading.one_at_a_time:
        other = threading.Thread(target=launch, args=(triple_kernel, 4, [array], device))
        other.start()
        other.join(timeout=120)
        assert not other.is_alive()
    assert (array.numpy() == 9).all()


LOADS_TWO_KERNELS = """
import sys, time
import warp as wp
from fresh_kernels import fresh_kernel, works
from warp_kernels.machinery import loading
wp.init()
wp.config.kernel_cache_dir, loading.SLOW = sys.argv[1], float(sys.argv[2])
for kernel in (fresh_kernel(), fresh_kernel()):
    with loading.first_use(kernel, wp.get_device("cpu"), 256):
        time.sleep(0.2)
        kernel.module.load("cpu", block_dim=1)
    assert works(kernel)
"""


def test_slow_compiling_is_told(tmp_path: Path) -> None:
    """Once, and neither where it is quick nor where a kernel is only loaded."""
    for cache, slow, told in (("a", 60.0, 0), ("a", 0.01, 0), ("b", 0.01, 1)):
        done = run_python("-c", LOADS_TWO_KERNELS, tmp_path / cache, slow)
        assert done.returncode == 0, done.stderr
        lines = [line for line in done.stderr.splitlines() if not line.startswith("Warp ")]
        assert len(lines) == told
        assert all(line.startswith("Compiling kernels") and "add_kernel" in line for line in lines)


def test_files_that_cannot_be_read_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Warp itself says of a compiled file only that loading failed; other errors stay what they are."""
    device = wp.get_device("cpu")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    kernel = fresh_kernel()
    with pytest.raises(ZeroDivisionError), first_use(kernel, device, 256):
        raise ZeroDivisionError

    def refuse(module: StoredModule) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied", str(module.folder / module.names[0]))

    monkeypatch.setattr(StoredModule, "is_whole", refuse)
    with pytest.raises(KernelCacheError, match=r"Permission denied .*\.o"), first_use(kernel, device, 256):
        pass
    with pytest.raises(KernelCacheError, match=r"Permission denied .*\.o"):
        must_compile([kernel], device)


CACHE_IS_NO_FOLDER = """
import sys, torch, warp as wp
from thermosplat.errors import UserError
from thermosplat.rasterizer import rasterization
if sys.argv[2] == "later":
    wp.init()
    wp.config.kernel_cache_dir = sys.argv[1]
else:
    wp.config.kernel_cache_dir = sys.argv[1]
ones = torch.ones(1, 3)
K = torch.tensor([[[9.0, 0, 8], [0, 9, 8], [0, 0, 1]]])
try:
    rasterization(ones, torch.ones(1, 4), ones, ones[:, 0], ones, torch.eye(4)[None], K, 16, 16)
except UserError as error:
    print(error.message, error.hint)
"""


@pytest.mark.parametrize("when", ["at once", "later"])
def test_a_cache_that_cannot_be_used_is_told(when: str, tmp_path: Path) -> None:
    """To users of the rasterizer, in a sentence that names the place and the variable."""
    (tmp_path / "file").touch()
    done = run_python("-c", CACHE_IS_NO_FOLDER, tmp_path / "file" / "cache", when, seconds=120)
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / "file") in done.stdout
    assert "WARP_CACHE_PATH=FOLDER" in done.stdout
