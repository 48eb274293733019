"""Bytes that a rank sends to others, counted where they are sent, and the time until what it gets has arrived."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from thermosplat.distributed import collectives
from thermosplat.rasterizer import exchange


@dataclass
class Exchanged:
    """What was exchanged in a block."""

    bytes: int = 0
    """Of projected Gaussians and of their gradients, to the other ranks."""
    seconds: float = 0.0
    """In the exchange, waiting for late ranks included."""


@contextmanager
def counted_bytes() -> Iterator[Exchanged]:
    """Around renders with ``distributed=True``, and backward passes; on CUDA each exchange is then waited for."""
    found, plain = Exchanged(), collectives.exchanged_rows

    def counted(rows: Tensor, sent: Sequence[int], received: Sequence[int]) -> Tensor:
        _wait(rows)
        started = time.perf_counter()
        arrived = plain(rows, sent, received)
        _wait(rows)
        found.seconds += time.perf_counter() - started
        found.bytes += rows.numel() * rows.element_size()
        return arrived

    exchange.exchanged_rows = counted
    try:
        yield found
    finally:
        exchange.exchanged_rows = plain


def _wait(tensor: Tensor) -> None:
    if tensor.is_cuda:
        torch.cuda.synchronize(tensor.device)
