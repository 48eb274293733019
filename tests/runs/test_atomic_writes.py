"""Files are whole or not there, and nothing is written through links that somebody laid."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import (
    NotWrittenError,
    check_is_no_link,
    is_temporary,
    open_to_append,
    plain_folder,
    sweep,
    write_atomically,
    write_text,
)


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    """A writer that fails half-way leaves the earlier file whole and nothing beside it."""
    path = tmp_path / "metrics.json"
    path.write_text("old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half")
        raise KeyError("stop")

    with pytest.raises(KeyError):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.json"]


def test_full_disk_is_a_user_error(tmp_path: Path) -> None:
    """No space is said in a sentence that names the file."""
    path = tmp_path / "step_000001.pt"

    def fail(temporary: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(UserError, match=r"step_000001\.pt: No space left on device"):
        write_atomically(path, fail)


def test_temporary_file_keeps_the_suffix(tmp_path: Path) -> None:
    """Image writers choose the format by suffix, so the temporary name has the same one."""
    suffixes = []

    def write(temporary: Path) -> None:
        suffixes.append(temporary.suffix)
        temporary.write_bytes(b"x")

    write_atomically(tmp_path / "new" / "strip.png", write)
    assert suffixes == [".png"]
    assert (tmp_path / "new" / "strip.png").read_bytes() == b"x"


def test_temporary_names_cannot_be_guessed(tmp_path: Path) -> None:
    """Each write has a name of its own, which sweeping knows; however long the file's name is."""
    names = set()

    def write(temporary: Path) -> None:
        names.add(temporary.name)
        temporary.write_bytes(b"x")

    for stem in ("a", "a", "b" * 240):
        write_atomically(tmp_path / f"{stem}.json", write)
    assert len(names) == 3
    assert all(map(is_temporary, names))
    assert not any(str(os.getpid()) in name.split(".") for name in names)


def test_a_link_is_replaced_and_not_followed(tmp_path: Path) -> None:
    """A link under the name of the file leads nowhere any more; what it led to is as it was."""
    outside = tmp_path / "outside"
    outside.write_text("mine")
    (tmp_path / "metrics.json").symlink_to(outside)
    write_text(tmp_path / "metrics.json", "new")
    assert outside.read_text() == "mine"
    assert not (tmp_path / "metrics.json").is_symlink()
    assert (tmp_path / "metrics.json").read_text() == "new"


@pytest.mark.parametrize("make", [Path.symlink_to, Path.hardlink_to])
def test_a_log_is_not_a_link(tmp_path: Path, make: Callable[[Path, Path], None]) -> None:
    """A log goes on at its end; a link to another file is refused, be it a symbolic one or not."""
    outside = tmp_path / "outside"
    outside.write_text("mine")
    make(tmp_path / "linked.log", outside)
    with pytest.raises(OSError, match=r"levels of symbolic links|plain file"):
        open_to_append(tmp_path / "linked.log")
    assert outside.read_text() == "mine"
    for line in (b"1", b"2"):
        with open_to_append(tmp_path / "plain.log") as file:
            file.write(line)
    assert (tmp_path / "plain.log").read_bytes() == b"12"


def test_a_pipe_is_no_log(tmp_path: Path) -> None:
    """Nobody waits for a reader of a named pipe."""
    os.mkfifo(tmp_path / "log")
    with pytest.raises(OSError, match=r"No such device|plain file"):
        open_to_append(tmp_path / "log")


def test_folders_below_the_result_folder_are_no_links(tmp_path: Path) -> None:
    """The result folder itself may be a link, as the user gave it; what lies in it may not."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    assert plain_folder(tmp_path / "run", "renders", "eval_000100").is_dir()
    (tmp_path / "outside").mkdir()
    (tmp_path / "disk" / "stats").symlink_to(tmp_path / "outside")
    for names in (("stats",), ("stats", "deeper")):
        with pytest.raises(NotWrittenError, match="stats is a link") as caught:
            plain_folder(tmp_path / "run", *names)
    assert f"rm {tmp_path / 'run' / 'stats'}" in caught.value.hint
    with pytest.raises(UserError, match="is a link"):
        check_is_no_link(tmp_path / "run" / "stats")
    assert list((tmp_path / "outside").iterdir()) == []


def test_what_killed_processes_left_is_swept(tmp_path: Path) -> None:
    """Temporary files go, of version 0.1 too; files that are being written, links and others' files stay."""
    left = [".step_000060.0123456789abcdef.tmp.pt", ".config.0123456789abcdef.tmp", ".step_000060.4711.tmp.pt"]
    others = ["step_000060.pt", ".hidden", ".notes.tmp", ".x.0123456789abcde.tmp.pt"]
    for name in (*left, *others):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "mine").write_bytes(b"x")
    (tmp_path / ".a.0123456789abcdef.tmp.pt").symlink_to(tmp_path / "outside" / "mine")

    def write(temporary: Path) -> None:
        temporary.write_text("whole")
        sweep(tmp_path)
        assert temporary.is_file()

    write_atomically(tmp_path / "metrics.json", write)
    assert (tmp_path / "metrics.json").read_text() == "whole"
    assert (tmp_path / "outside" / "mine").is_file()
    found = {entry.name for entry in tmp_path.iterdir() if entry.is_file() and not entry.is_symlink()}
    assert found == {*others, "metrics.json"}
    sweep(tmp_path / "missing")
