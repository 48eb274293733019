"""Launches spread over CPU threads."""

import multiprocessing
from collections.abc import Iterator

import numpy as np
import pytest
import warp as wp

from warp_kernels.machinery import launching
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.launching import RecordedLaunch


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


@wp.kernel(enable_backward=False, module="unique")
def mixed_kernel(
    flag: bool,
    small: int,
    values: wp.array(dtype=wp.vec3),
    large: wp.int64,
    exact: wp.float64,
    rows: wp.array2d(dtype=wp.float32),
    single: wp.float32,
    pair: wp.vec2,
    # outputs
    sums: wp.array(dtype=wp.float64),
):
    """Arguments of every size that there is, one beside another that is not its own."""
    i = wp.tid()
    total = (
        wp.float64(values[i][2])
        + wp.float64(rows[i, 1])
        + exact
        + wp.float64(single)
        + wp.float64(large)
        + wp.float64(pair[1])
    )
    if flag:
        total = total + wp.float64(small)
    sums[i] = total


def views(*arrays: wp.array) -> list[ArrayView]:
    """The same memory as views."""
    return [ArrayView(a.ptr, a.shape, a.dtype, a.device, a, None if a.is_contiguous else a.strides) for a in arrays]


@pytest.mark.parametrize("as_views", [False, True])
def test_each_launch_has_its_own_arguments(as_views: bool) -> None:
    """What was recorded first leaves no trace: other numbers, other arrays, another number of threads."""
    rng = np.random.default_rng(0)
    recorded = None
    for count, flag, small, large, exact, single in ((5, True, -3, 2**40, 0.1, 0.5), (2, False, 9, -7, 1e-9, -2.5)):
        values, columns = rng.random((count, 3), np.float32), rng.random((count, 4), np.float32)
        arrays = [
            wp.array(values, dtype=wp.vec3, device="cpu"),
            wp.array(columns, device="cpu")[:, 1:3],
            wp.zeros(count, dtype=wp.float64, device="cpu"),
        ]
        sums = arrays[2]
        rows, moved, out = views(arrays[0], arrays[1], sums) if as_views else arrays
        inputs = [flag, small, rows, large, exact, moved, wp.float32(single), wp.vec2(7.0, 2.0), out]
        recorded = recorded or RecordedLaunch(mixed_kernel, count, inputs, sums.device, 256)
        recorded.launch(count, inputs)
        expected = values[:, 2].astype(float) + columns[:, 2] + exact + single + large + 2.0 + (small if flag else 0)
        np.testing.assert_allclose(sums.numpy(), expected, rtol=1e-14)


@wp.struct
class Given:
    """A whole number that pads, arrays, and a flag at the end that pads what comes behind."""

    first: int
    values: wp.array(dtype=wp.float64)  # [2]
    scale: wp.float64
    absent: wp.array(dtype=wp.int32)  # [0]: there is none
    negative: bool


@wp.kernel(enable_backward=False, module="unique")
def struct_kernel(
    before: bool,
    given: Given,
    added: wp.float64,
    # outputs
    found: wp.array(dtype=wp.float64),  # [2]
):
    """Reads every field."""
    i = wp.tid()
    value = given.scale * given.values[given.first + i] + wp.float64(given.absent.shape[0])
    if given.negative and before:
        value = -value
    found[i] = value + added


def test_a_struct_is_given_by_its_fields() -> None:
    """One after the other, in every launch, with None for an array that there is not."""
    found = wp.zeros(2, dtype=wp.float64, device="cpu")
    recorded = None
    for first, scale, negative, absent in ((1, 2.0, True, None), (0, 0.5, False, wp.zeros(3, dtype=wp.int32))):
        values = wp.array(np.arange(1.0, 4.0), dtype=wp.float64, device="cpu")
        given = [first, views(values)[0], scale, absent, negative]
        inputs = [True, *given, 10.0, found]
        recorded = recorded or RecordedLaunch(struct_kernel, 2, inputs, found.device, 256)
        recorded.launch(2, inputs)
        expected = scale * values.numpy()[first : first + 2] + (0 if absent is None else 3)
        assert (found.numpy() == (-expected if negative else expected) + 10.0).all()


@wp.kernel(enable_backward=False, module="unique")
def grid_kernel(
    # outputs
    found: wp.array2d(dtype=wp.int32),  # [rows, columns]
):
    """Which threads there are."""
    i, j = wp.tid()
    found[i, j] = found[i, j] + 1


@pytest.mark.parametrize("dims", [((2, 3), (4, 1), (1, 1), (2, 3)), ((3, 2), (5, 4))])
def test_a_resized_launch_has_every_thread_once(dims: tuple[tuple[int, int], ...]) -> None:
    """Of more and of fewer rows and columns than before."""
    most = np.max(dims, axis=0)
    found = wp.zeros((int(most[0]), int(most[1])), dtype=wp.int32, device="cpu")
    recorded = RecordedLaunch(grid_kernel, dims[0], [found], found.device, 256)
    for rows, columns in dims:
        found.zero_()
        recorded.launch((rows, columns), [found])
        expected = np.zeros(found.shape, np.int32)
        expected[:rows, :columns] = 1
        assert (found.numpy() == expected).all()


def test_more_threads_than_32_bits_are_left_to_warp() -> None:
    """Which refuses what its threads cannot be numbered by."""
    found = wp.zeros((1, 1), dtype=wp.int32, device="cpu")
    recorded = RecordedLaunch(grid_kernel, (1, 1), [found], found.device, 256)
    with pytest.raises(ValueError, match="extent"):
        recorded.launch((2**31 + 1, 1), [found])
    recorded.launch((1, 1), [found])
    assert found.numpy().tolist() == [[1]]


@wp.kernel(enable_backward=False, module="unique")
def count_kernel(
    values: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=wp.float32),
    # outputs
    found: wp.array(dtype=wp.int32),
):
    """Extents of its arguments."""
    found[0] = values.shape[0]
    found[1] = rows.shape[0] + rows.shape[1]


def test_none_is_an_array_without_elements() -> None:
    """At any launch, also the one that is recorded, and what was given before leaves no trace."""
    found = wp.zeros(2, dtype=wp.int32, device="cpu")
    values, rows = wp.zeros(5, dtype=wp.vec3, device="cpu"), wp.zeros((2, 3), dtype=wp.float32, device="cpu")
    absent: list[tuple[wp.array | None, wp.array | None]] = [(None, rows), (values, None), (None, None), (values, rows)]
    recorded = RecordedLaunch(count_kernel, 1, [None, None, found], found.device, 256)
    for given in absent:
        (out,) = views(found)
        inputs = [None if one is None else views(one)[0] for one in given]
        recorded.launch(1, [*inputs, out])
        assert found.numpy().tolist() == [0 if given[0] is None else 5, 0 if given[1] is None else 5]
