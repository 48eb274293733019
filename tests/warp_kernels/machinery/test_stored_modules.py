"""Compiled kernels that are not whole are compiled again, whatever is wrong with which file; whole ones are not."""

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import warp as wp

from warp_kernels.machinery import loading, stored_modules
from warp_kernels.machinery.launching import launch
from warp_kernels.machinery.loading import must_compile
from warp_kernels.machinery.stored_modules import SEAL, StoredModule


@wp.kernel(enable_backward=False, module="unique")
def add_one_kernel(first: int, values: wp.array(dtype=wp.float32)):
    """Adds one to each value."""
    i = wp.tid() + first
    values[i] = values[i] + 1.0


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "cut in half": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "without its last byte": lambda content: content[:-1],
    "zeros": lambda content: bytes(len(content)),
    "zeros at the end": lambda content: content[: len(content) // 2].ljust(len(content), b"\0"),
    "a hole": lambda content: content[:64] + bytes(64) + content[128:],
    "other bytes": lambda content: os.urandom(len(content)),
    "one bit": lambda content: bytes([content[0] ^ 1]) + content[1:],
}


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with the kernel."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as monkeypatch:
        use(folder, monkeypatch)
        assert run() == 2
    return folder


@pytest.fixture
def cache(compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of it, which a process finds that has loaded nothing yet."""
    shutil.copytree(compiled, tmp_path / "cache")
    use(tmp_path / "cache", monkeypatch)
    yield tmp_path / "cache"
    add_one_kernel.module.unload()


def use(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wp.init()  # which chooses a folder of its own
    add_one_kernel.module.unload()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    monkeypatch.setattr(loading, "_loaded", set())
    monkeypatch.setattr(stored_modules, "_told_of_damage", False)
    monkeypatch.setattr("warp_kernels.machinery.launching._recorded.by_kernel", {})


def stored() -> StoredModule:
    return StoredModule.of(add_one_kernel, wp.get_device("cpu"), 256)


def file_of(kind: str) -> Path:
    names = {".o": stored().names[0], ".meta": stored().names[1], "seal": SEAL}
    return stored().folder / names[kind]


def run() -> float:
    values = wp.ones(4, dtype=wp.float32, device="cpu")
    launch(add_one_kernel, 4, [values], wp.get_device("cpu"))
    return float(values.numpy()[0])


@pytest.mark.rotating
@pytest.mark.parametrize("kind", [".o", ".meta", "seal"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_made_again(kind: str, damage: str, cache: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The kernel runs, what is wrong is said in one line, and the next process finds all whole."""
    path = file_of(kind)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert must_compile([add_one_kernel], wp.get_device("cpu"))
    assert run() == 2
    said = capfd.readouterr().err.splitlines()
    quiet = kind == "seal" and damage == "empty"  # as of a process that was killed before it sealed
    assert said == ([] if quiet else [f"Compiled kernels are damaged, and are compiled again: {stored().folder}"])
    assert stored().is_whole()


@pytest.mark.parametrize("lacking", [(), (".o",), (".meta",), ("seal",), (".o", ".meta", "seal")])
def test_what_is_there_is_not_compiled(lacking: tuple[str, ...], cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A whole module is loaded as it is; one that lacks a file or the seal is compiled."""
    for kind in lacking:
        file_of(kind).unlink()
    built = []
    build = wp._src.build.build_cpu
    monkeypatch.setattr(wp._src.build, "build_cpu", lambda *words, **named: built.append(1) or build(*words, **named))
    assert must_compile([add_one_kernel], wp.get_device("cpu")) == bool(lacking)
    assert run() == 2
    assert len(built) == bool(lacking)
    assert not must_compile([add_one_kernel], wp.get_device("cpu"))


def test_files_for_other_devices_stay(cache: Path) -> None:
    """A damaged file of one device is no reason to compile for another one."""
    other = stored().folder / "module.sm90.cubin"
    other.write_bytes(b"of a GPU")
    file_of(".o").write_bytes(b"")
    assert run() == 2
    assert other.read_bytes() == b"of a GPU"


def test_a_cache_that_can_only_be_read(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What others compiled and did not seal is used; what is damaged there is an error that names the file."""
    file_of("seal").unlink()
    make = os.open

    def refuse(path: os.PathLike[str], flags: int, *rest: int) -> int:
        if flags & os.O_RDWR and str(path).startswith(str(cache)):
            raise OSError(30, "Read-only file system", str(path))
        return make(path, flags, *rest)

    monkeypatch.setattr(stored_modules.os, "open", refuse)
    assert run() == 2
    file_of("seal").write_text("{}x")
    use(cache, monkeypatch)
    with pytest.raises(loading.KernelCacheError, match=r"Read-only file system .*seal\.json"):
        run()


def test_a_full_disk_is_an_error(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LLVM would end the process. What is whole is loaded all the same."""
    monkeypatch.setattr(stored_modules, "LEAST_ROOM", 2**70)
    assert run() == 2
    file_of(".o").write_bytes(b"")
    use(cache, monkeypatch)
    with pytest.raises(loading.KernelCacheError, match="No space left on device"):
        run()


def test_who_comes_later_waits_for_the_first(cache: Path) -> None:
    """Of two processes that find the same damage one compiles, and the other one finds all whole."""
    file_of(".o").write_bytes(b"")
    whole = threading.Event()

    def come_later() -> None:
        with stored().loaded():
            if stored().is_whole():
                whole.set()

    with stored().loaded():
        other = threading.Thread(target=come_later)
        other.start()
        time.sleep(0.2)  # it waits, or it would find the files that are written next not to be sealed
        for kind in (".o", ".meta"):
            file_of(kind).write_bytes(b"compiled")
    other.join(timeout=60)
    assert whole.is_set()
