"""Checkpoints beside the training: one at a time, of the state they were begun with, and no failure forgotten."""

import errno
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import NotWrittenError
from thermosplat.runs.checkpoint_file import save_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.session import checkpoint_writer
from thermosplat.training.session.checkpoint_writer import CheckpointWriter, naming_the_newest_checkpoint

pytestmark = pytest.mark.usefixtures("stoppable")


def saved(path: Path) -> float:
    """The one number in a file."""
    return float(torch.load(path, weights_only=True)["means"])


def fail(path: Path, state: dict[str, Any]) -> Path:
    raise NotWrittenError(f"Could not write {path}: No space left on device.")


def test_what_changes_after_the_block_is_not_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is written when the block has long ended, and holds what there was in it."""
    trained = threading.Event()

    def save(path: Path, state: dict[str, Any]) -> Path:
        assert trained.wait(10)
        return save_checkpoint(path, state)

    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", save)
    means, writer = torch.tensor(1.0), CheckpointWriter(print)
    with writer.beginning(tmp_path / "1.pt", {"means": means}):
        pass
    means += 1
    writer.tell_failure()  # does not wait
    assert list(tmp_path.iterdir()) == []
    trained.set()
    writer.wait()
    assert saved(tmp_path / "1.pt") == 1


def test_one_file_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is begun, or written at once, while another is under way comes after it; even where it is the same file."""
    under_way: list[float] = []
    at_once = []

    def save(path: Path, state: dict[str, Any]) -> Path:
        under_way.append(float(state["means"]))
        threading.Event().wait(0.05)
        at_once.append(list(under_way))
        under_way.pop()
        return save_checkpoint(path, state)

    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", save)
    writer = CheckpointWriter(print)
    for value in (1.0, 2.0):
        with writer.beginning(tmp_path / "x.pt", {"means": torch.tensor(value)}):
            pass
    writer.write(tmp_path / "x.pt", {"means": torch.tensor(3.0)})
    assert at_once == [[1.0], [2.0], [3.0]]
    assert saved(tmp_path / "x.pt") == 3
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.pt"]


@pytest.mark.parametrize("call", ["tell_failure", "wait", "beginning", "write"])
def test_failure_is_told_once_by_the_next_call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    """A full disk is said by whichever call is next, which does its own work all the same."""
    begun = threading.Event()

    def begin_to_fail(path: Path, state: dict[str, Any]) -> Path:
        begun.set()
        return fail(path, state)

    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", begin_to_fail)
    said: list[str] = []
    means, writer = torch.tensor(1.0), CheckpointWriter(said.append)
    with writer.beginning(tmp_path / "1.pt", {"means": means}):
        pass
    assert begun.wait(10)
    monkeypatch.undo()
    arguments = (tmp_path / "2.pt", {"means": means})
    calls: dict[str, Callable[[], object]] = {
        "tell_failure": writer.tell_failure,
        "wait": writer.wait,
        "beginning": lambda: ExitStack().enter_context(writer.beginning(*arguments)),
        "write": lambda: writer.write(*arguments),
    }
    until = time.monotonic() + 10
    calls[call]()
    while call == "tell_failure" and not said and time.monotonic() < until:  # it waits for no write
        calls[call]()
    assert len(said) == 1
    writer.tell_failure()
    writer.wait()
    assert said == [f"Could not write {tmp_path / '1.pt'}: No space left on device. Training goes on without it."]
    assert [entry.name for entry in tmp_path.iterdir()] == (["2.pt"] if call in ("write", "beginning") else [])


def test_what_there_is_to_go_on_from_is_named(tmp_path: Path) -> None:
    """A full disk at the end of a training: the newest checkpoint and the command, or that there is none."""
    run = RunDirectory.create(tmp_path)
    with pytest.raises(UserError, match="No checkpoint of this training is saved"), naming_the_newest_checkpoint(run):
        fail(run.checkpoint(9), {})
    run.checkpoint(4).write_bytes(b"x")
    both = r"step_000009\.pt: No space left.*step_000004\.pt"
    with pytest.raises(UserError, match=both) as caught, naming_the_newest_checkpoint(run):
        fail(run.checkpoint(9), {})
    assert run.resume_command() in caught.value.hint


def test_older_checkpoints_make_room_for_the_last_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a full disk the oldest goes first, and is named; the newest stays, whatever happens."""
    run, said = RunDirectory.create(tmp_path), list[str]()
    for step in (4, 8, 10, 12):
        run.checkpoint(step).write_bytes(b"x")

    def save(path: Path, state: dict[str, Any]) -> Path:
        if len(run.checkpoints()) > state["room"]:
            raise NotWrittenError(f"Could not write {path}.") from OSError(errno.ENOSPC, "No space left on device")
        return save_checkpoint(path, state)

    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", save)
    writer = CheckpointWriter(said.append)
    writer.write_last(run, run.checkpoint(20), {"room": 2})
    assert [path.name for path in run.checkpoints()] == ["step_000010.pt", "step_000012.pt", "step_000020.pt"]
    assert [line.split()[4] for line in said] == [str(run.checkpoint(4)), str(run.checkpoint(8))]
    run.checkpoint(20).unlink()
    with pytest.raises(NotWrittenError, match="Could not write"):
        writer.write_last(run, run.checkpoint(20), {"room": 0})
    assert [path.name for path in run.checkpoints()] == ["step_000012.pt"]


def test_no_checkpoint_is_deleted_in_vain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the older ones together are too small for the last one, all of them stay."""
    run = RunDirectory.create(tmp_path)
    for step in (4, 8, 10):
        run.checkpoint(step).write_bytes(b"x" * 100)

    def save(path: Path, state: dict[str, Any]) -> Path:
        raise NotWrittenError(f"Could not write {path}.") from OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", save)
    monkeypatch.setattr(checkpoint_writer.shutil, "disk_usage", lambda path: SimpleNamespace(free=50))
    with pytest.raises(NotWrittenError):
        CheckpointWriter(print).write_last(run, run.checkpoint(20), {"means": torch.zeros(63)})
    assert len(run.checkpoints()) == 3
    with pytest.raises(NotWrittenError):
        CheckpointWriter(print).write_last(run, run.checkpoint(20), {"means": torch.zeros(62)})
    assert len(run.checkpoints()) == 2


def test_a_disk_that_cannot_be_written_to_costs_no_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only room helps against a full disk; nothing is deleted for another reason."""
    run = RunDirectory.create(tmp_path)
    for step in (4, 8):
        run.checkpoint(step).write_bytes(b"x")
    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", fail)
    with pytest.raises(NotWrittenError):
        CheckpointWriter(print).write_last(run, run.checkpoint(20), {})
    assert len(run.checkpoints()) == 2


def test_state_that_cannot_be_gathered_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A host without memory for a copy is an error of the write; a later one has none of it."""

    def exhausted(state: object) -> object:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr(checkpoint_writer, "on_host", exhausted)
    means, writer = torch.tensor(1.0), CheckpointWriter(print)
    with writer.beginning(tmp_path / "1.pt", {"means": means}):
        pass
    with pytest.raises(RuntimeError, match="can't allocate memory"):
        writer.wait()
    writer.write(tmp_path / "2.pt", {"means": means})
    assert [entry.name for entry in tmp_path.iterdir()] == ["2.pt"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_block_that_fails_leaves_a_whole_file(tmp_path: Path, error: type[BaseException]) -> None:
    """The write goes on, whatever ends the block."""
    means, writer = torch.tensor(1.0), CheckpointWriter(print)
    with pytest.raises(error), writer.beginning(tmp_path / "1.pt", {"means": means}):
        raise error
    means += 1
    writer.wait()
    assert saved(tmp_path / "1.pt") == 1


def test_interrupt_waits_for_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while a file is waited for is acted on when it is complete."""
    writer = CheckpointWriter(print)

    def save(path: Path, state: dict[str, Any]) -> Path:
        os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(0.1)
        return save_checkpoint(path, state)

    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", save)
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012  it may come in either
        with writer.beginning(tmp_path / "1.pt", {"means": torch.tensor(1.0)}):
            pass
        writer.wait()
    writer.wait()
    assert saved(tmp_path / "1.pt") == 1
