"""Launches spread over CPU threads."""

import multiprocessing
from collections.abc import Iterator

import numpy as np
import pytest
import warp as wp

from warp_kernels.machinery import launching


@wp.kernel(enable_backward=False, module="unique")
def square_kernel(first: int, values: wp.array(dtype=wp.float32), squares: wp.array(dtype=wp.float32)):
    """Adds the square of each value to its own place."""
    i = wp.tid() + first
    squares[i] = squares[i] + values[i] * values[i]


@wp.kernel(enable_backward=False, module="unique")
def mark_kernel(first: int, marks: wp.array2d(dtype=wp.int32)):
    """Counts the visits of each (tile, thread)."""
    tile, thread = wp.tid()
    marks[tile + first, thread] = marks[tile + first, thread] + 1


@pytest.fixture(autouse=True)
def _restore_threads() -> Iterator[None]:
    threads = launching.num_threads()
    yield
    launching.set_num_threads(threads)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 2 * launching.MIN_CHUNK - 1, 2 * launching.MIN_CHUNK, 50_001])
def test_every_index_once(count: int, threads: int) -> None:
    """Each index of the range is visited exactly once, whatever the number of threads."""
    launching.set_num_threads(threads)
    values = np.arange(count, dtype=np.float32) % 97
    squares = wp.zeros(count, dtype=wp.float32, device="cpu")
    launching.launch(
        square_kernel, count, [wp.array(values, dtype=wp.float32, device="cpu"), squares], wp.get_device("cpu")
    )
    assert (squares.numpy() == values * values).all()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("tiles", [1, 2, 77])
def test_every_tile_once(tiles: int, threads: int) -> None:
    """Each (tile, thread) pair is visited exactly once."""
    launching.set_num_threads(threads)
    marks = wp.zeros((tiles, 4), dtype=wp.int32, device="cpu")
    launching.launch_tiles(mark_kernel, tiles, 4, [marks], wp.get_device("cpu"))
    assert (marks.numpy() == 1).all()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # Python 3.12, of a process with threads
def test_a_forked_process_launches_too() -> None:
    """A data loader's worker, say, whose parent has already spread launches over its threads."""
    test_every_tile_once(tiles=77, threads=2)
    child = multiprocessing.get_context("fork").Process(target=test_every_tile_once, args=(77, 2))
    child.start()
    child.join(timeout=120)
    child.kill()
    child.join()
    assert child.exitcode == 0


def test_thread_count_must_be_positive() -> None:
    """Zero threads cannot work."""
    with pytest.raises(ValueError, match="at least 1"):
        launching.set_num_threads(0)
    assert launching.num_threads() >= 1


def test_launches_are_not_recorded_on_a_tape() -> None:
    """A tape that happens to be active does not see them: adjoints are recorded by hand."""
    squares = wp.zeros(8, dtype=wp.float32, device="cpu", requires_grad=True)
    values = wp.array(np.ones(8), dtype=wp.float32, device="cpu", requires_grad=True)
    with wp.Tape() as tape:
        launching.launch(square_kernel, 8, [values, squares], wp.get_device("cpu"))
    assert tape.launches == []
