"""The content of a file as bytes, in memory or read where they are looked at."""

import struct
from typing import Any, BinaryIO, overload


class FileBytes:
    """A file as bytes that are read where they are looked at."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, key: int) -> int: ...
    @overload
    def __getitem__(self, key: slice) -> bytes: ...
    def __getitem__(self, key: int | slice) -> int | bytes:
        if isinstance(key, int):
            return self[key : key + 1][0]
        start, stop, _ = key.indices(self._size)
        self._file.seek(start)
        return self._file.read(max(stop - start, 0))


Content = bytes | FileBytes


def unpacked(layout: str, content: Content, at: int) -> tuple[Any, ...]:
    """Numbers of a ``struct`` layout from a place on.

    Raises:
        struct.error: The content ends before.
    """
    return struct.unpack(layout, content[at : at + struct.calcsize(layout)])
