"""Ctrl-C, SIGTERM and SIGHUP wait for what must not stop half-way, and are not forgotten."""

import contextlib
import os
import signal
import threading
import time

import pytest

from thermosplat.stop_signals import (
    STOP_SIGNALS,
    Stopped,
    deferred_interrupts,
    handled_signals,
    held_stop_signals,
    raise_lost_stop,
    signal_of,
    stopped_by_signals,
)

pytestmark = pytest.mark.usefixtures("stoppable")


@pytest.fixture(autouse=True)
def _python_sigint(stoppable: None) -> None:
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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_other_stop_signals_wait_like_ctrl_c(number: signal.Signals) -> None:
    """They are raised at the end of the outer block, as an interrupt that knows its signal; then all is as before."""
    done = []
    before = signal.getsignal(number)
    with pytest.raises(Stopped) as caught, stopped_by_signals(), stopped_by_signals():  # noqa: PT012  it comes at the block's end
        with deferred_interrupts():
            with deferred_interrupts():
                os.kill(os.getpid(), number)
                done.append("inner")
            done.append("outer")
        done.append("after")
    assert done == ["inner", "outer"]
    assert signal_of(caught.value) == number
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_lost_stop_is_heard(number: signal.Signals) -> None:
    """What C code has cleared is raised again, and is forgotten with the block."""
    with stopped_by_signals():
        raise_lost_stop()
        with contextlib.suppress(Stopped):
            os.kill(os.getpid(), number)
            time.sleep(1)
        with pytest.raises(Stopped) as caught:
            raise_lost_stop()
    assert signal_of(caught.value) == number
    raise_lost_stop()


def test_ignored_signals_stay_ignored() -> None:
    """What nohup has set is kept, also by a block that defers."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopped_by_signals(), deferred_interrupts():
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_held_signals_come_afterwards(number: signal.Signals) -> None:
    """To this thread; the block itself is left alone, and so are blocks around it."""
    heard: list[int] = []
    with handled_signals(lambda number, _: heard.append(number)):
        with held_stop_signals():
            with held_stop_signals():
                signal.raise_signal(number)
            assert not heard
        assert heard == [number]


def test_a_forked_process_decides_before_it_hears() -> None:
    """A signal that comes before it has chosen is judged by what it chooses."""
    with handled_signals(signal.SIG_DFL), held_stop_signals():
        pid = os.fork()
        if pid == 0:
            os.kill(os.getpid(), signal.SIGHUP)  # as somebody else may, at once
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
            os._exit(7)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7
