"""Files written by a few threads beside the computation of what goes into the next ones."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

THREADS = 4
"""As many files are written, or wait for it in memory, at once. To encode a PNG of 1208x644 takes a core 50 ms, several
times what a GPU takes to render such frames and to measure them."""


@contextmanager
def background_writes() -> Iterator[Callable[[Callable[[], object]], None]]:
    """Around a loop that makes files: yields what takes the work of writing one, to be done in another thread.

    Where files are made faster than they are written, it waits for the oldest, so that memory stays bounded. When the
    block ends, everything is written; what a write raised is raised by a later call or at the end.
    """
    writing: deque[Future[object]] = deque()
    with ThreadPoolExecutor(THREADS) as threads:

        def write(work: Callable[[], object]) -> None:
            if len(writing) == THREADS:
                writing.popleft().result()
            writing.append(threads.submit(work))

        yield write
        for file in writing:
            file.result()
