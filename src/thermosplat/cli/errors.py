"""How commands end: 0, 2 with a panel for a mistake of the user's, 128 + its number after a signal (130: Ctrl-C)."""

import errno
import sys
from collections.abc import Callable

from rich.console import Group
from rich.panel import Panel
from rich.text import Text

from thermosplat.cli.host_settings import allowed_memory
from thermosplat.errors import UserError
from thermosplat.printing import SafeConsole, printable, safe_output
from thermosplat.stop_signals import signal_of, stopped_by_signals

USER_ERROR = 2
_REFUSALS = {
    errno.ENAMETOOLONG: "Give a shorter name.",
    errno.ELOOP: "Its links lead in a circle: give a path without them.",
    errno.ENOTDIR: "A file is in place of a folder: give another path.",
    errno.EISDIR: "A folder is in place of a file: give another path.",
    errno.EACCES: "See to it that it can be read and written, or give another path.",
    errno.EPERM: "See to it that it can be read and written, or give another path.",
    errno.EROFS: "Give a path on a disk that can be written to.",
    errno.ENOSPC: "Free some space, or give a path on another disk.",
    errno.EDQUOT: "Free some space, or give a path on another disk.",
}
"""Why the system may refuse a path, wherever that comes up, and what helps."""
_OUT_OF_MEMORY = (
    "annot allocate memory",
    "can't allocate memory",
    "failed to map segment",
    "Failed to allocate",
    "Insufficient memory",
    "can't start new thread",
)
_SHOWN_NAME = 120
"""Letters of a path that are shown."""


def run_command(body: Callable[[], int], *, debug: bool, one_line: bool = False) -> int:
    """Run a command and turn what a user can mend into a message and an exit code.

    Args:
        body: The command; returns its exit code.
        one_line: Say what is wrong in one line without a panel, for programs that read it.

    Returns:
        The exit code. Errors that are no mistake of the user's are raised as they are.
    """
    with safe_output(), stopped_by_signals():
        return _code_of(body, debug, print_error_line if one_line else print_error)


def _code_of(body: Callable[[], int], debug: bool, tell: Callable[[str, str], None]) -> int:
    try:
        return body()
    except SystemExit as stop:  # --help, or flags that tyro does not understand
        if not isinstance(stop.code, int):
            raise
        return stop.code
    except UserError as error:
        if debug:
            SafeConsole(stderr=True).print_exception()
        tell(error.message, error.hint)
        return USER_ERROR
    except KeyboardInterrupt as stop:
        print("Interrupted.", file=sys.stderr)
        return 128 + signal_of(stop)
    except Exception as error:
        refusal = _refusal_of(error)
        if debug or refusal is None:
            raise
        tell(*refusal)
        return USER_ERROR


def _refusal_of(error: Exception) -> tuple[str, str] | None:
    """What the system refused, a path or memory, and what helps; None for other errors."""
    if isinstance(error, OSError) and error.errno in _REFUSALS and error.filename:
        name = str(error.filename)
        shown = name if len(name) <= _SHOWN_NAME else f"{name[:_SHOWN_NAME]}... ({len(name):,} letters)"
        return f"{shown} cannot be used: {error.strerror}.", _REFUSALS[error.errno]
    if _is_out_of_memory(error):
        limit = allowed_memory()
        told = "" if limit is None else f" A process may have {limit / 2**30:.1f} GiB here (ulimit -v)."
        return f"Out of memory.{told}", "Close other programs that use this device, and try again."
    return None


def print_error(message: str, hint: str = "") -> None:
    """Print a red panel on stderr."""
    lines = [Text(printable(message))]
    if hint:
        lines += [Text(), Text(printable(hint), style="bold")]
    panel = Panel(Group(*lines), title="Error", title_align="left", style="red")
    SafeConsole(stderr=True, highlight=False).print(panel)


def print_error_line(message: str, hint: str) -> None:
    """Print an error as one line on stderr, the last one: see :func:`print_error`."""
    print(" ".join(f"Error: {message} {hint}".split()), file=sys.stderr, flush=True)


def _is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out, as Python, torch, Warp, OpenCV or the loader of libraries say it, or one they name."""
    of_torch = type(error).__name__ == "OutOfMemoryError"
    if of_torch or isinstance(error, MemoryError) or any(words in str(error) for words in _OUT_OF_MEMORY):
        return True
    cause = error.__cause__ or error.__context__
    return cause is not None and _is_out_of_memory(cause)
