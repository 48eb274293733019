"""Compiled kernels in Warp's cache, and whether they are whole: a power cut or a full disk leaves files without an end.

Warp loads what is there, and ends in an error, at a later launch, or in a crash. So beside the files of a module lies a
seal with their SHA-256, written when they have been compiled and loaded. What has no seal, or another one, is compiled
again. The seal is also what processes lock that compile the same module.
"""

import errno
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import warp as wp

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

SEAL = "seal.json"
LEAST_ROOM = 32 << 20
"""Bytes that the disk must have free before anything is compiled: LLVM ends the process where it cannot write. The
kernels of a training take 2 MB on the CPU."""

_told_of_damage: set[Path] = set()
"""Caches of which it was told."""


class StoredModule(NamedTuple):
    """The files of a module that are loaded for a device."""

    folder: Path
    names: tuple[str, str]
    """Of the compiled file and of what Warp knows about it."""

    @classmethod
    def of(cls, kernel: wp.Kernel, device: wp.Device, block: int) -> "StoredModule":
        """Where Warp keeps what it compiles of a kernel."""
        module, block = kernel.module, 1 if device.is_cpu else block
        folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim=block)
        return cls(folder, (module._get_compile_output_name(device, block_dim=block), module._get_meta_name(block)))

    def is_whole(self) -> bool:
        """Whether all is there as it was when it was compiled.

        Raises:
            OSError: if a file cannot be read.
        """
        sealed, found = self._sealed(), self._digests()
        return len(found) == len(self.names) and all(sealed.get(name) == digest for name, digest in found.items())

    @contextmanager
    def loaded(self) -> Iterator[None]:
        """Around the loading of the module by Warp, which compiles what is missing. What is damaged is missing.

        Raises:
            OSError: if the folder cannot be read, or if it is to be written and cannot be or has no room.
        """
        if self.is_whole():
            yield
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            seal = os.open(self.folder / SEAL, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            if self._sealed():
                raise
            yield  # somebody else has compiled it, and it can only be read
            return
        try:
            with suppress(OSError):  # a file system without locks
                if fcntl is not None:
                    fcntl.flock(seal, fcntl.LOCK_EX)
            if not self.is_whole():  # another process may have compiled it meanwhile
                self._remove()
                self._check_room()
            yield
            with suppress(OSError):  # a full disk: compiled again another time
                of_others = {name: digest for name, digest in self._sealed().items() if name != SEAL}
                content = json.dumps(of_others | self._digests()).encode()
                os.ftruncate(seal, 0)
                os.pwrite(seal, content, 0)
        finally:
            os.close(seal)

    def _check_room(self) -> None:
        disk = shutil.disk_usage(self.folder)
        if disk.total > 0 and disk.free < LEAST_ROOM:  # some systems tell neither
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.folder))

    def _remove(self) -> None:
        sealed, found = self._sealed(), self._digests()
        if SEAL in sealed or any(name in sealed and sealed[name] != found.get(name) for name in self.names):
            _tell_of_damage(self.folder)
        for name in self.names:
            (self.folder / name).unlink(missing_ok=True)

    def _sealed(self) -> dict[str, str]:
        """The seal; empty where there is none. One that is damaged fits no file."""
        try:
            content = (self.folder / SEAL).read_bytes()
        except OSError:
            return {}
        with suppress(ValueError):
            sealed = json.loads(content)
            if isinstance(sealed, dict):
                return sealed
        return {SEAL: "damaged"} if content else {}

    def _digests(self) -> dict[str, str]:
        paths = [self.folder / name for name in self.names]
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.exists()}


def _tell_of_damage(folder: Path) -> None:
    if folder.parent not in _told_of_damage:
        print(f"Compiled kernels are damaged, and are compiled again: {folder}", file=sys.stderr, flush=True)
    _told_of_damage.add(folder.parent)
