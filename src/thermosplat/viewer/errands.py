"""What one tab asks for, done one thing after the other in a thread of its own, until the tab is closed.

viser would do it in threads that all tabs share. So nobody waits for the errands of another tab, two quick clicks are
done in their order, and what a tab still waits for ends with it.
"""

import threading
from collections import deque
from collections.abc import Callable

from thermosplat.errors import UserError
from thermosplat.viewer.freed_memory import give_back
from thermosplat.viewer.notices import NOTICES
from thermosplat.viewer.turns import ViewingEnded

MOST_WAITING = 100
"""Errands that may wait. One more is left out: those that wait read the newest values of their controls."""
Errand = Callable[[], None]


class Errands:
    """Does what a tab asks for.

    Args:
        name: Of the thread.

    Attributes:
        waiting: What is asked for and not begun.
    """

    def __init__(self, name: str, tell: Callable[[str, str], None]) -> None:
        self._tell = tell
        self.waiting: deque[Errand] = deque()
        self._news = threading.Condition()
        self._ended = False
        self._long = threading.Lock()
        self._long_thread: threading.Thread | None = None
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    def begin(self) -> None:
        """Begin to do what is asked for."""
        self._thread.start()

    def add(self, errand: Errand) -> None:
        """Do something after what is asked for already; returns at once."""
        with self._news:
            if not self._ended and len(self.waiting) < MOST_WAITING:
                self.waiting.append(errand)
                self._news.notify_all()

    def begin_long(self, errand: Errand) -> None:
        """Do something that takes long beside the others, if no such thing is done already.

        Args:
            errand: Ends with ``ViewingEnded`` when the tab is closed.
        """
        if not self._long.acquire(blocking=False):
            self._tell("One after the other", "A picture or a video of this tab is being made.")
            return

        def work() -> None:
            try:
                self._do(errand)
                give_back()
            finally:
                self._long.release()

        self._long_thread = threading.Thread(target=work, name=f"{self._thread.name}, long", daemon=True)
        self._long_thread.start()

    def end(self) -> None:
        """Do nothing more."""
        with self._news:
            self._ended = True
            self.waiting.clear()
            self._news.notify_all()

    @property
    def threads(self) -> list[threading.Thread]:
        """Those in which something may be done now."""
        return [thread for thread in (self._thread, self._long_thread) if thread is not None and thread.is_alive()]

    def _work(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._ended or self.waiting)
                if self._ended:
                    return
                errand = self.waiting.popleft()
            self._do(errand)
            del errand  # its controls hold the tab

    def _do(self, errand: Errand) -> None:
        try:
            errand()
        except ViewingEnded:
            pass
        except UserError as error:
            self._tell("Not done", f"{error.message} {error.hint}".rstrip())
        except Exception as error:
            NOTICES.say_error("something that a visitor asked for failed", error)
            self._tell("Not done", str(error)[:300])
