"""How commands end: 0, 2 with a panel for a mistake of the user's, 130 after Ctrl-C."""

import sys
from collections.abc import Callable

from rich.console import Console, Group
from rich.panel import Panel
from rich.text import Text

from thermosplat.errors import UserError

USER_ERROR = 2
INTERRUPTED = 130


def run_command(body: Callable[[], int], *, debug: bool) -> int:
    """Run a command and turn what a user can mend into a message and an exit code.

    Args:
        body: The command; returns its exit code.
        debug: Show the traceback too.

    Returns:
        The exit code. Errors that are no mistake of the user's are raised as they are.
    """
    try:
        return body()
    except UserError as error:
        if debug:
            Console(stderr=True).print_exception()
        print_error(error.message, error.hint)
        return USER_ERROR
    except KeyboardInterrupt:
        Console(stderr=True).print("Interrupted.")
        return INTERRUPTED
    except (RuntimeError, MemoryError) as error:
        if debug or not _is_out_of_memory(error):
            raise
        print_error("Out of memory.", "Close other programs that use this device, and try again.")
        return USER_ERROR


def print_error(message: str, hint: str = "") -> None:
    """Print a red panel on stderr.

    Args:
        message: What is wrong.
        hint: What to do about it.
    """
    lines = [Text(message)]
    if hint:
        lines += [Text(), Text(hint, style="bold")]
    Console(stderr=True, highlight=False).print(Panel(Group(*lines), title="Error", title_align="left", style="red"))


def _is_out_of_memory(error: BaseException) -> bool:
    if "torch" not in sys.modules:
        return isinstance(error, MemoryError)
    from thermosplat.training.out_of_memory import is_out_of_memory

    return is_out_of_memory(error)
