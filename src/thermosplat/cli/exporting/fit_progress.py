"""How far the fit of the splats is: a bar on a terminal, a line now and then elsewhere."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence

from thermosplat.printing import SafeConsole

LINE_EVERY = 10.0
"""Seconds between lines."""


def shown_steps(steps: Sequence[int], name: str, *, clock: Callable[[], float] = time.monotonic) -> Iterable[int]:
    """Steps to be done one after the other, shown to whoever waits for them.

    Args:
        steps: All of them.
        name: The spectrum whose splats are fitted.
        clock: Seconds.
    """
    console = SafeConsole()
    if not console.is_terminal:
        return _with_lines(steps, name, clock)
    from rich.progress import track

    return track(steps, f"Fitting {name}", console=console, transient=True)


def _with_lines(steps: Sequence[int], name: str, clock: Callable[[], float]) -> Iterator[int]:
    started = said = clock()
    for done, step in enumerate(steps):
        if clock() >= said + LINE_EVERY:
            said = clock()
            print(f"Fitting {name}: step {done:,} of {len(steps):,} after {said - started:.0f} s", flush=True)
        yield step
