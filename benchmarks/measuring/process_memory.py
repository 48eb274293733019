"""Memory of a process and of those that it started."""

from pathlib import Path
from typing import NamedTuple


class HostMemory(NamedTuple):
    """Proportional set sizes [bytes]: what processes share is divided among them."""

    process: int
    """Of the process itself."""
    children: int
    """Of those that it started, and of theirs."""

    @property
    def total(self) -> int:
        """Of all."""
        return self.process + self.children


def memory_of(pid: int) -> HostMemory:
    """Memory of a process and of its children, now.

    Args:
        pid: The process.
    """
    below = children(pid)
    return HostMemory(_proportional(pid), sum(map(_proportional, below)))


def children(pid: int) -> list[int]:
    """Processes that a process has started, and those that these have started."""
    found: list[int] = []
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            for child in map(int, thread.read_text().split()):
                found += [child, *children(child)]
        except OSError:  # it has ended
            continue
    return found


def _proportional(pid: int) -> int:
    try:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return 0
