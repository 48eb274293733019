"""Images of a capture that is larger than memory, as bytes on the disk: each is decoded and undistorted once.

The files lie in a folder of the run. Their names say what they were made of, so that a resumed run finds its own again,
and nothing is taken for what it is not. What cannot be kept is made again when it is needed.

A file is one of numpy's, with a sum over its content behind it. Nobody waits until it has reached the disk. After a
power cut a file may therefore hold what was never written; its sum is wrong then, and it is made again.
"""

import contextlib
import functools
import io
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from thermosplat.runs.atomic_writes import NotWrittenError, write_atomically
from thermosplat.runs.written_files import KEPT_PIXELS

_SUM_BYTES = 8


class PixelCache:
    """Arrays on the disk; none are kept until a folder is named."""

    def __init__(self) -> None:
        self.folder: Path | None = None

    def open(self, folder: Path, keys: Collection[str]) -> None:
        """Keep arrays in a folder from now on.

        Args:
            folder: The folder; it exists. Files of other keys in it, which older settings left, are deleted.
        """
        for file in folder.iterdir():
            if KEPT_PIXELS.fullmatch(file.name) and file.name.partition(".")[0] not in keys:
                file.unlink(missing_ok=True)
        self.folder = folder

    def close(self) -> None:
        """Keep nothing any more, and delete what was kept."""
        folder, self.folder = self.folder, None
        if folder is None:
            return
        with contextlib.suppress(OSError):  # somebody else has deleted it
            for file in folder.iterdir():
                if KEPT_PIXELS.fullmatch(file.name):
                    file.unlink(missing_ok=True)
            folder.rmdir()

    def load(self, key: str, part: str) -> NDArray[Any] | None:
        """An array that was kept; None where there is none, or what is left of one."""
        if self.folder is None:
            return None
        try:
            with self._path(self.folder, key, part).open("rb") as file:
                array = _array_of_header(file)
                return array if array is not None and _read(file, array) else None
        except (OSError, ValueError, EOFError):
            return None

    def load_into(self, key: str, part: str, array: NDArray[Any]) -> bool:
        """Read an array that was kept into one of the same shape and type. The other arguments are those of ``keep``.

        Args:
            array: Where the numbers go, in one piece.

        Returns:
            Whether there is such an array; if not, the numbers may be anything.
        """
        if self.folder is None:
            return False
        header = _header(array.dtype.str, array.shape)
        try:
            with self._path(self.folder, key, part).open("rb") as file:
                return file.read(len(header)) == header and _read(file, array)
        except OSError:
            return False

    def has(self, key: str, part: str) -> bool:
        """Whether an array was kept."""
        return self.folder is not None and self._path(self.folder, key, part).is_file()

    def keep(self, key: str, part: str, array: NDArray[Any]) -> None:
        """Keep an array, if it can be written.

        Args:
            key: 32 hexadecimal digits: what it was made of.
            part: Which of the arrays made of that.
        """
        if self.folder is None or not self.folder.is_dir():  # the result folder may have been moved away
            return
        whole = np.ascontiguousarray(array)

        def write(path: Path) -> None:
            with path.open("wb") as file:
                file.write(_header(whole.dtype.str, whole.shape))
                file.write(_bytes(whole))
                file.write(_sum(whole))

        with contextlib.suppress(NotWrittenError):
            write_atomically(self._path(self.folder, key, part), write, durable=False)

    @staticmethod
    def _path(folder: Path, key: str, part: str) -> Path:
        return folder / f"{key}.{part}.npy"


@functools.lru_cache(maxsize=64)
def _header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """What numpy's files begin with, for an array in C order."""
    written = io.BytesIO()
    np.lib.format.write_array_header_1_0(written, {"descr": dtype, "fortran_order": False, "shape": shape})
    return written.getvalue()


def _array_of_header(file: BinaryIO) -> NDArray[Any] | None:
    """An array like the one whose header an open file begins with; None where the rest of the file is none of ours."""
    if np.lib.format.read_magic(file) != (1, 0):
        return None
    shape, in_fortran_order, dtype = np.lib.format.read_array_header_1_0(file)
    count = int(np.prod(shape, dtype=object))
    rest = os.fstat(file.fileno()).st_size - file.tell()
    if in_fortran_order or dtype.hasobject or count * dtype.itemsize + _SUM_BYTES != rest:
        return None
    return np.empty(shape, dtype)


def _read(file: BinaryIO, array: NDArray[Any]) -> bool:
    """Read the numbers that follow the header, and whether they are those that were written."""
    content = _bytes(array)
    return file.readinto(content) == len(content) and file.read(_SUM_BYTES + 1) == _sum(array)  # type: ignore[attr-defined]


def _bytes(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _sum(array: NDArray[Any]) -> bytes:
    """The sum of the content as 64-bit words. Blocks that never reached the disk are zeros, or of another file. A
    checksum that would notice exchanged words takes several times the time of reading them."""
    content = array.reshape(-1).view(np.uint8)
    whole = len(content) // 8 * 8
    last = int.from_bytes(content[whole:].tobytes(), "little")
    total = int(content[:whole].view(np.uint64).sum(dtype=np.uint64)) + last
    return (total % (1 << 64)).to_bytes(_SUM_BYTES, "little")
