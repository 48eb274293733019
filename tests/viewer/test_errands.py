"""What a tab asks for is done in its order, by itself, and ends with it; what fails says so in one line."""

import threading
from collections.abc import Iterator

import pytest

from thermosplat.errors import UserError
from thermosplat.viewer.errands import MOST_WAITING, Errands
from thermosplat.viewer.turns import ViewingEnded

PATIENCE = 60.0


@pytest.fixture
def told() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def errands(told: list[tuple[str, str]]) -> Iterator[Errands]:
    made = Errands("test", lambda title, body: told.append((title, body)))
    made.begin()
    yield made
    made.end()


def all_done(errands: Errands) -> None:
    done = threading.Event()
    errands.add(done.set)
    assert done.wait(PATIENCE)


def test_errands_are_done_in_their_order(errands: Errands, told: list[tuple[str, str]]) -> None:
    """One that fails stops none of the others."""
    done: list[int] = []

    def fail(error: Exception) -> None:
        raise error

    for number in range(20):
        errands.add(lambda number=number: done.append(number))
    for error in (ValueError("bad"), ViewingEnded(), UserError("No bookmark.", "Add one.")):
        errands.add(lambda error=error: fail(error))
    all_done(errands)
    assert done == list(range(20))
    assert told == [("Not done", "bad"), ("Not done", "No bookmark. Add one.")]


def test_only_so_many_wait(errands: Errands) -> None:
    """A page that asks without end fills no memory; after the end nothing is done."""
    go, done = threading.Event(), []
    errands.add(lambda: go.wait(PATIENCE) and None)
    for number in range(10 * MOST_WAITING):
        errands.add(lambda number=number: done.append(number))
    assert len(errands.waiting) <= MOST_WAITING
    go.set()
    while errands.waiting:
        pass
    all_done(errands)
    assert MOST_WAITING - 1 <= len(done) <= MOST_WAITING + 1
    errands.end()
    errands.add(lambda: done.append(-1))
    for thread in errands.threads:
        thread.join(PATIENCE)
    assert not errands.threads
    assert -1 not in done


def test_one_long_thing_at_a_time(errands: Errands, told: list[tuple[str, str]]) -> None:
    """Beside the others, which do not wait for it; a second one is refused until the first is done."""
    go, ended = threading.Event(), threading.Event()

    def wait() -> None:
        go.wait(PATIENCE)
        ended.set()

    errands.begin_long(wait)
    all_done(errands)
    errands.begin_long(lambda: pytest.fail("two at once"))
    assert [title for title, _ in told] == ["One after the other"]
    go.set()
    assert ended.wait(PATIENCE)
    for thread in errands.threads:
        if thread.name.endswith("long"):
            thread.join(PATIENCE)
    again = threading.Event()
    errands.begin_long(again.set)
    assert again.wait(PATIENCE)
