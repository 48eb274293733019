"""Work beside a training is complete when its block ends."""

import contextlib
import os
import signal
import threading
import time

import pytest

from thermosplat.training.session.interruption import meanwhile

pytestmark = pytest.mark.usefixtures("stoppable")


@pytest.fixture(autouse=True)
def _python_sigint(stoppable: None) -> None:
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, ZeroDivisionError])
def test_meanwhile_is_done_at_the_end(error: type[BaseException] | None) -> None:
    """Work beside a block is complete after it, whether the block ends by itself, by Ctrl-C or by an error."""
    entered, done = threading.Event(), []

    def work() -> None:
        entered.wait(10)
        done.append(1)

    with pytest.raises(error) if error is not None else contextlib.nullcontext(), meanwhile(work):
        assert done == []
        entered.set()
        if error is not None:
            raise error
    assert done == [1]


def test_meanwhile_raises_what_the_work_raised() -> None:
    """An error in the other thread is not lost."""

    def work() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), meanwhile(work):
        pass


def test_meanwhile_waits_for_work_that_was_interrupted_at_its_start() -> None:
    """Ctrl-C at the moment in which the other thread starts: whether or not the block begins, the work is complete."""
    done = []

    def work() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        done.append(1)

    for count in range(1, 31):
        with pytest.raises(KeyboardInterrupt), meanwhile(work):
            time.sleep(10)
        assert len(done) == count
