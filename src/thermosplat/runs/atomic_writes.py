"""Files that appear at once and whole, and nowhere else than where they were meant to be.

Content goes into a temporary file beside its place. Nobody can guess its name, so a link that somebody laid there is
never followed, and the rename at the end replaces a link instead of following it. The temporary file is locked while it
is written: one that nobody has locked was left by a process that was killed.
"""

import contextlib
import errno
import fcntl
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from thermosplat.errors import UserError

_TEMPORARY = re.compile(r"\..+\.(([0-9a-f]{16}|\d+)\.tmp(\..+)?|\d+\.mp4)")
"""Names of temporary files; those of version 0.1 had the number of the process in place of 16 random digits."""
_SHOWN_STEM = 40
"""Letters of a file's name that its temporary file shows: a name has 255 bytes at most."""


class NotWrittenError(UserError):
    """A file or folder could not be written: a full disk, no permission. What was there before is as it was."""

    @property
    def disk_is_full(self) -> bool:
        """Whether it would be written if there were more room."""
        return isinstance(self.__cause__, OSError) and self.__cause__.errno in (errno.ENOSPC, errno.EDQUOT)


def write_atomically(path: Path, write: Callable[[Path], None], *, durable: bool = True) -> None:
    """Write a file so that its name only ever holds a complete one.

    Args:
        path: Where the file goes. Its folder is created.
        write: Writes the file to the temporary path it is given, which lies in the same folder and has the same suffix.
        durable: It is complete after a power cut, too. That waits for the disk.

    Raises:
        NotWrittenError: If the folder or the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _temporary_beside(path) as temporary:
            write(temporary)
            if durable:
                with temporary.open("rb+") as file:
                    os.fsync(file.fileno())  # the data before the name, or a power cut leaves an empty file under it
            os.replace(temporary, path)
    except OSError as error:
        raise _not_written(path, error) from error


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, with its line ends as they are; see :func:`write_atomically`.

    Bytes of a file's name that are no UTF-8 are written as escapes.
    """
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file of a known content; see :func:`write_atomically`."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(content)

    write_atomically(path, write)


def open_to_append(path: Path) -> IO[bytes]:
    """A log file, opened to write at its end. It is made where there is none.

    Args:
        path: The file; never a link.

    Raises:
        OSError: It cannot be opened, or is something else than a file of one name.
    """
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    try:
        check_is_plain(file)
        return os.fdopen(file, "ab")
    except BaseException:
        os.close(file)
        raise


def check_is_plain(file: int) -> None:
    """Whether an open file is a regular one that has no other name, under which it might lie outside of a folder.

    Raises:
        OSError: It is not.
    """
    found = os.fstat(file)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
        raise OSError(errno.EINVAL, "it is not a plain file of its own")


def plain_folder(root: Path, *names: str) -> Path:
    """A folder in a folder, at any depth. What is missing is made; links are not followed below the first folder.

    Args:
        root: A folder that is trusted to lead where it shall; it may be a link.

    Raises:
        NotWrittenError: One of them is a link or a file, or cannot be made.
    """
    folder = root
    try:
        root.mkdir(parents=True, exist_ok=True)
        for name in names:
            folder = folder / name
            check_is_no_link(folder)
            folder.mkdir(exist_ok=True)
    except OSError as error:
        raise NotWrittenError(
            f"Could not make the folder {folder}: {error.strerror}.",
            "Move what is in its way, or see to it that the result folder can be written to.",
        ) from error
    return folder


def check_is_no_link(folder: Path) -> None:
    """Refuse a folder that leads elsewhere.

    Raises:
        NotWrittenError: It is a link.
    """
    if folder.is_symlink():
        raise NotWrittenError(
            f"{folder} is a link. thermosplat writes and deletes nothing through links inside a result folder.",
            f"Remove the link: rm {folder}. Results on another disk: give a --result-dir there.",
        )


def is_temporary(name: str) -> bool:
    """Whether a file of this name is one that is being written, or that a killed process left."""
    return _TEMPORARY.fullmatch(name) is not None


def sweep(folder: Path) -> None:
    """Delete the temporary files in a folder that no process writes any more. Where they cannot be told, they stay.

    Args:
        folder: The folder; it may be missing.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        left = [Path(entry.path) for entry in entries if is_temporary(entry.name) and not entry.is_symlink()]
        for path in left:
            with contextlib.suppress(OSError):  # it is being written, or another process sweeps too
                file = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    path.unlink()
                finally:
                    os.close(file)


@contextmanager
def _temporary_beside(path: Path) -> Iterator[Path]:
    """A new empty file of this process in the same folder, with the same suffix; gone at the end of the block."""
    temporary, file = _new_file(path)
    try:
        yield temporary
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        os.close(file)


def _new_file(path: Path) -> tuple[Path, int]:
    """A temporary file and its open, locked descriptor."""
    while True:
        temporary = path.with_name(f".{path.stem[:_SHOWN_STEM]}.{secrets.token_hex(8)}.tmp{path.suffix}")
        file = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        if os.fstat(file).st_nlink > 0:
            return temporary, file
        os.close(file)  # swept between its making and its lock


def _not_written(path: Path, error: OSError) -> NotWrittenError:
    return NotWrittenError(
        f"Could not write {path}: {error.strerror or error}.", "Free some space, or choose another folder to write to."
    )
