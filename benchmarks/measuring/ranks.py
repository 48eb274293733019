"""Processes that measure together."""

import os
import sys
from collections.abc import Callable
from typing import Any

import torch.multiprocessing as processes


def on_ranks(ranks: int, function: Callable[..., None], *arguments: Any) -> None:
    """Call ``function(rank, *arguments)`` in so many new processes, and wait for them.

    Args:
        ranks: Processes.
        function: Of an importable module.
        *arguments: What can be pickled.

    Raises:
        torch.multiprocessing.ProcessRaisedException: The function failed in one of them.
    """
    processes.spawn(_to_its_end, (function, arguments), nprocs=ranks)


def _to_its_end(rank: int, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    """Call it, and end without Python's own end.

    A thread of gloo may still hold a tensor then, and a process whose thread lets go of one after Python's end aborts.
    """
    function(rank, *arguments)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)
