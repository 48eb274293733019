"""One training a result folder at a time: a file in it names the process that writes there.

The operating system lets go of the file when the process ends, however it ends, so what a crash leaves behind is in
nobody's way. On a file system that cannot tell, the process's number decides.
"""

import errno
import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import check_is_plain

LOCK_FILE = "training.lock"


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Keep other processes from training into a folder during the block; nested blocks of one process are one.

    Raises:
        UserError: Another process trains there, or the file cannot be written.
    """
    path = folder / LOCK_FILE
    taken = _take(path)
    try:
        yield
    finally:
        if taken is not None:
            for name in (path, Path(os.readlink(f"/proc/self/fd/{taken}"))):  # the folder may have been renamed
                if _is_still(taken, name):
                    name.unlink(missing_ok=True)  # before it is let go, so that nobody's else is deleted
            os.close(taken)


def _take(path: Path) -> int | None:
    """The open file, locked and with this process in it; None if an outer block has it."""
    ours = (os.getpid(), socket.gethostname())
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        except OSError as error:
            raise _not_written(path, error) from error
        taken = False
        try:
            check_is_plain(file)
            free, holder = _lock(file), _holder(file)
            if holder == ours and free is not True:
                return None
            if free is False or (holder is not None and holder != ours and not _has_ended(holder, free)):
                raise _being_trained(path, holder)
            if not _is_still(file, path):
                continue  # whoever had it has ended since and deleted it
            os.ftruncate(file, 0)
            os.pwrite(file, f"{ours[0]} {ours[1]}\n".encode(), 0)
            taken = True
            return file
        except OSError as error:
            raise _not_written(path, error) from error
        finally:
            if not taken:
                os.close(file)


def _lock(file: int) -> bool | None:
    """Whether nobody had it locked; None where the file system has no locks."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def _holder(file: int) -> tuple[int, str] | None:
    """Process and host in the file; None where it holds none, as in the moment after it was made."""
    number, _, host = os.pread(file, 4096, 0).decode(errors="replace").strip().partition(" ")
    return (int(number), host) if number.isdecimal() and host else None


def _has_ended(holder: tuple[int, str], free: bool | None) -> bool:
    number, host = holder
    if host != socket.gethostname():
        return False  # its locks may not be seen from here
    if free is None:
        try:
            os.kill(number, 0)
        except ProcessLookupError:
            return True
        except PermissionError:  # another user's
            return False
        return False
    return free


def _is_still(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _being_trained(path: Path, holder: tuple[int, str] | None) -> UserError:
    process = "another process" if holder is None else f"process {holder[0]} on {holder[1]}"
    hint = "Wait for it, or give another --result-dir."
    if holder is not None and holder[1] != socket.gethostname():
        hint = f"{hint} If that process has ended, delete {path}."
    return UserError(f"{path.parent} is being trained by {process}.", hint)


def _not_written(path: Path, error: OSError) -> UserError:
    if path.is_symlink():
        return UserError(f"{path} is a link, through which thermosplat does not write.", f"Delete it: rm {path}")
    return UserError(
        f"Could not write {path}: {error.strerror or error}.", "Free some space, or give another --result-dir."
    )
