"""What the viewer says on the terminal of what its visitors do: one line each, and few of them.

A line never has more than printable ASCII in it, so nothing that a visitor sends reaches the terminal as it was sent.
Where there is more to say than the pace allows, the next line has the number of those that were left out.
"""

import logging
import sys
import threading
import time
from collections.abc import Callable

AT_ONCE = 5
"""Lines that may come one after the other."""
SECONDS = 10.0
"""Afterwards there is one line in so many seconds."""
LONGEST = 300
"""Letters of a line."""


class Notices(logging.Handler):
    """Says lines at a bounded pace, on stderr; also those of a logger, without their tracebacks.

    Args:
        clock: What tells the time [s].

    Attributes:
        clock: As given.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(logging.WARNING)
        self.clock = clock
        self._saying = threading.Lock()
        self._free_at = -AT_ONCE * SECONDS
        self._left_out = 0

    def say(self, text: str) -> None:
        """Say something, or count it as left out.

        Args:
            text: What; control characters and letters beyond ASCII become escapes.
        """
        with self._saying:
            now = self.clock()
            self._free_at = max(self._free_at, now - AT_ONCE * SECONDS)
            if self._free_at + SECONDS > now:
                self._left_out += 1
                return
            self._free_at += SECONDS
            more, self._left_out = self._left_out, 0
        shown = ascii(" ".join(text.split()))[1:-1][:LONGEST]
        print(f"Viewer: {shown}" + (f" (and {more:,} like it before)" if more else ""), file=sys.stderr, flush=True)

    def say_error(self, what: str, error: BaseException) -> None:
        """Say that something failed, and why."""
        self.say(f"{what}: {type(error).__name__}: {error}")

    def emit(self, record: logging.LogRecord) -> None:
        """Say what a logger has to say."""
        error = record.exc_info[1] if record.exc_info else None
        if error is None:
            self.say(record.getMessage())
        else:
            self.say_error(record.getMessage(), error)


NOTICES = Notices()
"""Those of this process."""
