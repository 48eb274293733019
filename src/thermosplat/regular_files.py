"""Files and folders from strangers: only regular files are read, and a walk through folders ends.

A pipe without a writer would be waited for without end, a device may never end, and the system's own folders (/proc)
hold a picture of the whole machine.
"""

import errno
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_SYSTEM = ("/proc", "/sys")
"""Folders of Linux whose files are made while they are read."""


def open_regular(path: Path) -> BinaryIO:
    """A file opened for reading.

    Args:
        path: The file, or a link to one.

    Raises:
        OSError: It cannot be opened, or is no regular file; ``strerror`` says which.
    """
    try:
        _check_regular(path, os.stat(path).st_mode)
    except ValueError as error:  # a zero byte in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        _check_regular(path, os.fstat(handle).st_mode)  # another may have taken its place
    except OSError:
        os.close(handle)
        raise
    return open(handle, "rb")


def read_regular(path: Path) -> bytes:
    """The content of a file.

    Raises:
        OSError: As ``open_regular``.
    """
    with open_regular(path) as file:
        return file.read(os.fstat(file.fileno()).st_size)  # no more: room for what is asked for is taken first


def files_in(folder: Path) -> list[Path]:
    """The regular files of a folder itself, sorted by name; none where there is no such folder."""
    if not os.path.isdir(folder):  # also for a name that is too long
        return []
    return sorted(path for path in folder.iterdir() if os.path.isfile(path))


def files_below(folder: Path) -> list[Path]:
    """The regular files of a folder at any depth, sorted, also in folders that are links.

    Each folder counts once, as links may go in a circle. A link to a folder that it lies in, and one to the system's
    own, is not followed.
    """
    return sorted(_walk(folder))


def _walk(folder: Path) -> Iterator[Path]:
    place_of_link = os.path.realpath(folder.parent) if os.path.islink(folder) else None
    top = os.path.realpath(folder)
    seen = set()
    for place, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        inside = top if real != top else place_of_link
        if real in seen or (inside is not None and _holds(real, inside)) or any(_holds(one, real) for one in _SYSTEM):
            folders.clear()
            continue
        seen.add(real)
        folders.sort()
        yield from (path for name in files if os.path.isfile(path := Path(place, name)))


def _holds(folder: str, path: str) -> bool:
    """Whether a path is a folder or lies in it."""
    return os.path.commonpath([folder, path]) == folder


def _check_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kinds = (("pipe", stat.S_ISFIFO), ("folder", stat.S_ISDIR), ("socket", stat.S_ISSOCK))
        kind = next((name for name, is_kind in kinds if is_kind(mode)), "device")
        raise OSError(errno.EINVAL, f"it is a {kind}, not a file", str(path))
