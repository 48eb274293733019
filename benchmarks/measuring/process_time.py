"""What processors have done for the processes that a process has started."""

import os
from pathlib import Path

from measuring.process_memory import children


def seconds_of_children(pid: int) -> float:
    """Time that the living children of a process, and theirs, have run so far [s].

    Args:
        pid: The process.
    """
    return sum(map(_seconds, children(pid)))


def _seconds(pid: int) -> float:
    try:
        # behind the name in parentheses; utime and stime are fields 14 and 15 (proc(5))
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # it has ended
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
