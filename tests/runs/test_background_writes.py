"""Files written beside a loop: all of them, within bounds, and with their errors."""

import threading
from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.runs.background_writes import THREADS, background_writes


def test_everything_is_written_when_the_block_ends(tmp_path: Path) -> None:
    """More files than threads, each written, none in the thread of the loop."""
    writers = []

    def write_file(path: Path) -> None:
        writers.append(threading.current_thread())
        path.write_text(path.name)

    paths = [tmp_path / f"{number}.txt" for number in range(3 * THREADS)]
    with background_writes() as write:
        for path in paths:
            write(lambda path=path: write_file(path))
    assert [path.read_text() for path in paths] == [path.name for path in paths]
    assert threading.current_thread() not in writers


def test_few_files_wait() -> None:
    """The loop goes on while files are written, until as many wait as there are threads."""
    allowed = threading.Event()
    with background_writes() as write:
        for _ in range(THREADS):
            write(allowed.wait)
        assert not allowed.is_set()
        threading.Timer(0.05, allowed.set).start()
        write(lambda: None)
        assert allowed.is_set()


@pytest.mark.parametrize("later", [0, THREADS])
def test_an_error_surfaces(later: int, tmp_path: Path) -> None:
    """What a write raises is raised, by a later call or at the end of the block; files before it are there."""

    def fail() -> None:
        raise UserError("Could not write.")

    def loop() -> None:
        with background_writes() as write:
            write((tmp_path / "before.txt").touch)
            write(fail)
            for number in range(later):
                write((tmp_path / f"{number}.txt").touch)

    with pytest.raises(UserError, match="Could not write"):
        loop()
    assert (tmp_path / "before.txt").exists()


def test_an_error_of_the_loop_waits_for_the_files(tmp_path: Path) -> None:
    """Whatever ends the loop, what was handed over is written."""

    def loop() -> None:
        with background_writes() as write:
            write((tmp_path / "a.txt").touch)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop()
    assert (tmp_path / "a.txt").exists()
