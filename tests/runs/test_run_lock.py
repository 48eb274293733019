"""A result folder has one training at a time, and a crashed one is in nobody's way."""

import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.runs.run_lock import LOCK_FILE, run_lock

HOLDS = """
import sys
from pathlib import Path
from thermosplat.runs.run_lock import run_lock
with run_lock(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


@contextmanager
def other_process(folder: Path) -> "Iterator[subprocess.Popen[str]]":
    """A process that holds the folder's lock until its standard input is closed."""
    path = os.pathsep.join(filter(None, sys.path))
    with subprocess.Popen(
        [sys.executable, "-c", HOLDS, folder],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        yield process


def no_locks(*_: object) -> None:
    raise OSError(errno.ENOTSUP, "Operation not supported")


@pytest.mark.parametrize("has_locks", [True, False])
def test_second_process_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_locks: bool) -> None:
    """The message names folder, process and machine; when that one has ended, the folder is free and clean."""
    if not has_locks:
        monkeypatch.setattr(fcntl, "flock", no_locks)
    run = RunDirectory(tmp_path)
    with other_process(tmp_path) as process:
        name = rf"{tmp_path} is being trained by process {process.pid} on {socket.gethostname()}\."
        with pytest.raises(UserError, match=name):
            run.locked().__enter__()
        process.communicate("")
    assert not (tmp_path / LOCK_FILE).exists()
    with run.locked():
        assert (tmp_path / LOCK_FILE).read_text() == f"{os.getpid()} {socket.gethostname()}\n"
    assert not (tmp_path / LOCK_FILE).exists()


@pytest.mark.parametrize("has_locks", [True, False])
def test_killed_process_is_in_nobodys_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_locks: bool) -> None:
    """What a process leaves behind that could not tidy up is taken over."""
    with other_process(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert (tmp_path / LOCK_FILE).is_file()
    if not has_locks:
        monkeypatch.setattr(fcntl, "flock", no_locks)
    with run_lock(tmp_path):
        assert (tmp_path / LOCK_FILE).read_text().startswith(f"{os.getpid()} ")
    assert not (tmp_path / LOCK_FILE).exists()


def test_process_of_another_machine_counts_as_running(tmp_path: Path) -> None:
    """Whether it still runs cannot be seen from here, so the message says what to delete."""
    (tmp_path / LOCK_FILE).write_text("4711 elsewhere\n")
    with pytest.raises(UserError, match="is being trained by process 4711 on elsewhere") as caught:
        run_lock(tmp_path).__enter__()
    assert f"delete {tmp_path / LOCK_FILE}" in caught.value.hint
    assert (tmp_path / LOCK_FILE).read_text() == "4711 elsewhere\n"


def test_nested_blocks_of_one_process(tmp_path: Path) -> None:
    """The outer block keeps the folder until its own end."""
    with run_lock(tmp_path):
        with run_lock(tmp_path):
            pass
        assert (tmp_path / LOCK_FILE).is_file()
    assert not (tmp_path / LOCK_FILE).exists()


def test_file_that_was_deleted_meanwhile_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between opening the file and locking it, its owner may have ended: a lock on a deleted file keeps nobody out."""
    genuine, deleted = fcntl.flock, []

    def lock(file: int, operation: int) -> None:
        if not deleted:
            deleted.append(True)
            (tmp_path / LOCK_FILE).unlink()
        genuine(file, operation)

    monkeypatch.setattr(fcntl, "flock", lock)
    with run_lock(tmp_path):
        assert (tmp_path / LOCK_FILE).read_text() == f"{os.getpid()} {socket.gethostname()}\n"


def test_folder_that_cannot_be_written_to(tmp_path: Path) -> None:
    """The file that could not be made is named."""
    (tmp_path / LOCK_FILE).mkdir()
    with pytest.raises(UserError, match=r"Could not write .*training\.lock: Is a directory"):
        run_lock(tmp_path).__enter__()


@pytest.mark.parametrize("make", [Path.symlink_to, Path.hardlink_to])
def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path: Path, make: Callable[[Path, Path], None]) -> None:
    """Whatever a link of that name leads to keeps its content, and the message names the link."""
    (tmp_path / "mine").write_text("kept")
    make(tmp_path / LOCK_FILE, tmp_path / "mine")
    with pytest.raises(UserError, match=r"training\.lock(: it is not a plain file| is a link)"):
        run_lock(tmp_path).__enter__()
    assert (tmp_path / "mine").read_text() == "kept"


def test_a_folder_that_was_replaced_keeps_its_lock(tmp_path: Path) -> None:
    """A run whose folder was renamed does not take away the lock of the one that was begun in its place."""
    (tmp_path / "run").mkdir()
    with run_lock(tmp_path / "run"):
        (tmp_path / "run").rename(tmp_path / "renamed")
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / LOCK_FILE).write_text("4711 elsewhere\n")
    assert (tmp_path / "run" / LOCK_FILE).read_text() == "4711 elsewhere\n"
