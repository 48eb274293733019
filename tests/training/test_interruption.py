"""Ctrl-C waits for what must not stop half-way, and is not forgotten."""

import contextlib
import os
import signal
import threading
import time

import pytest

from thermosplat.training.interruption import deferred_interrupts, meanwhile


@pytest.fixture(autouse=True)
def _python_sigint() -> None:
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_block_is_finished_first() -> None:
    """An interrupt inside the block is raised at its end."""
    done = []

    def work() -> None:
        with deferred_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
            done.append(1)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == [1]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_nested_blocks_finish_all() -> None:
    """An interrupt inside an inner block waits for the outer one as well."""
    done = []

    def work() -> None:
        with deferred_interrupts():
            with deferred_interrupts():
                os.kill(os.getpid(), signal.SIGINT)
                done.append("inner")
            done.append("outer")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["inner", "outer"]


def test_last_block_swallows() -> None:
    """Where the program ends anyway, a second Ctrl-C changes nothing."""
    with deferred_interrupts(redeliver=False), deferred_interrupts():
        os.kill(os.getpid(), signal.SIGINT)


def test_error_goes_before_interrupt() -> None:
    """An error in the block is what the caller sees, and Ctrl-C works again."""

    def work() -> None:
        with deferred_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_other_threads_can_use_it() -> None:
    """In a thread, where no signals arrive and none may be set, the block just runs."""
    done = []

    def work() -> None:
        with deferred_interrupts():
            done.append(1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [1]


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
