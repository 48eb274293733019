"""Compiled kernels that are not whole are compiled again, whatever is wrong with which file; whole ones are not."""

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import warp as wp

from fresh_kernels import compiled_elsewhere, fresh_kernel, works
from warp_kernels.machinery import loading, stored_modules
from warp_kernels.machinery.loading import must_compile
from warp_kernels.machinery.stored_modules import SEAL, StoredModule

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


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty one."""
    wp.init()  # which chooses a folder of its own
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Found(NamedTuple):
    """A kernel that is compiled in a cache."""

    kernel: wp.Kernel
    stored: StoredModule

    def file(self, kind: str) -> Path:
        """One of its files."""
        names = {".o": self.stored.names[0], ".meta": self.stored.names[1], "seal": SEAL}
        return self.stored.folder / names[kind]

    def must_compile(self) -> bool:
        """Whether a file of it is missing or damaged."""
        return must_compile([self.kernel], wp.get_device("cpu"))


@pytest.fixture
def found(cache: Path) -> Found:
    """What a process finds that has loaded nothing yet."""
    kernel = fresh_kernel()
    return Found(kernel, compiled_elsewhere(kernel, cache))


@pytest.mark.rotating
@pytest.mark.parametrize("kind", [".o", ".meta", "seal"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_made_again(kind: str, damage: str, found: Found, capfd: pytest.CaptureFixture[str]) -> None:
    """The kernel runs, what is wrong is said in one line, and the next process finds all whole."""
    path = found.file(kind)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert found.must_compile()
    assert works(found.kernel)
    said = capfd.readouterr().err.splitlines()
    quiet = kind == "seal" and damage == "empty"  # as of a process that was killed before it sealed
    assert said == ([] if quiet else [f"Compiled kernels are damaged, and are compiled again: {found.stored.folder}"])
    assert found.stored.is_whole()


@pytest.mark.parametrize("lacking", [(), (".o",), (".meta",), ("seal",), (".o", ".meta", "seal")])
def test_what_is_there_is_not_compiled(lacking: tuple[str, ...], found: Found, monkeypatch: pytest.MonkeyPatch) -> None:
    """A whole module is loaded as it is; one that lacks a file or the seal is compiled."""
    for kind in lacking:
        found.file(kind).unlink()
    built = []
    build = wp._src.build.build_cpu
    monkeypatch.setattr(wp._src.build, "build_cpu", lambda *words, **named: built.append(1) or build(*words, **named))
    assert found.must_compile() == bool(lacking)
    assert works(found.kernel)
    assert len(built) == bool(lacking)
    assert not found.must_compile()


def test_files_for_other_devices_stay(found: Found) -> None:
    """A damaged file of one device is no reason to compile for another one."""
    other = found.stored.folder / "module.sm90.cubin"
    other.write_bytes(b"of a GPU")
    found.file(".o").write_bytes(b"")
    assert works(found.kernel)
    assert other.read_bytes() == b"of a GPU"


def test_a_cache_that_can_only_be_read(found: Found, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What others compiled and did not seal is used; what is damaged there is an error that names the file."""
    found.file("seal").unlink()
    other = fresh_kernel()
    damaged = Found(other, compiled_elsewhere(other, cache))
    damaged.file("seal").write_text("{}x")
    make = os.open

    def refuse(path: os.PathLike[str], flags: int, *rest: int) -> int:
        if flags & os.O_RDWR and str(path).startswith(str(cache)):
            raise OSError(30, "Read-only file system", str(path))
        return make(path, flags, *rest)

    monkeypatch.setattr(stored_modules.os, "open", refuse)
    assert works(found.kernel)
    with pytest.raises(loading.KernelCacheError, match=r"Read-only file system .*seal\.json"):
        works(damaged.kernel)


def test_a_full_disk_is_an_error(found: Found, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LLVM would end the process. What is whole is loaded all the same."""
    other = fresh_kernel()
    damaged = Found(other, compiled_elsewhere(other, cache))
    damaged.file(".o").write_bytes(b"")
    monkeypatch.setattr(stored_modules, "LEAST_ROOM", 2**70)
    assert works(found.kernel)
    with pytest.raises(loading.KernelCacheError, match="No space left on device"):
        works(damaged.kernel)


def test_who_comes_later_waits_for_the_first(found: Found) -> None:
    """Of two processes that find the same damage one compiles, and the other one finds all whole."""
    found.file(".o").write_bytes(b"")
    whole = threading.Event()

    def come_later() -> None:
        with found.stored.loaded():
            if found.stored.is_whole():
                whole.set()

    with found.stored.loaded():
        other = threading.Thread(target=come_later)
        other.start()
        time.sleep(0.2)  # it waits, or it would find the files that are written next not to be sealed
        for kind in (".o", ".meta"):
            found.file(kind).write_bytes(b"compiled")
    other.join(timeout=60)
    assert whole.is_set()
