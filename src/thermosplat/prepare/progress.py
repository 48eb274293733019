"""A bar for work that takes its time, on a terminal; nothing where there is none."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from thermosplat.printing import SafeConsole

Item = TypeVar("Item")


@contextmanager
def progress_bar(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show how far a piece of work has come.

    Yields:
        A function that takes the number of parts that have been done since its last call.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = SafeConsole(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(description, total=total)
        yield lambda parts: bars.advance(task, parts)


def tracked(items: Iterable[Item], description: str, total: int) -> Iterator[Item]:
    """Pass items on, and show how far they have come."""
    with progress_bar(description, total) as advance:
        for item in items:
            yield item
            advance(1)
