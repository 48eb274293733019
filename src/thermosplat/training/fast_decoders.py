"""The decoders as training runs them on CUDA: compiled, their matrix products on tensor cores.

Only training steps see them like this; evaluation and rendering use the plain decoders in full float32.
"""

import importlib.util
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from thermosplat.decoders import Decoders

BRANCHES = ("rgb", "thermal", "both")
"""Methods of Decoders that turn features into images."""


class FastDecoders:
    """Swaps compiled branches in and out of decoders.

    Args:
        decoders: The decoders.
        compiled: Let torch.compile join their element-wise work into few kernels; takes some seconds once a size.
        tf32: Round the inputs of matrix products to TensorFloat-32 (10 bits of mantissa instead of 23).
    """

    def __init__(self, decoders: Decoders, *, compiled: bool, tf32: bool) -> None:
        self.decoders = decoders
        self._branches: dict[str, Callable[..., Any]] = {}
        if compiled:
            self._branches = {name: torch.compile(getattr(decoders, name), dynamic=False) for name in BRANCHES}
        self._precision = "high" if tf32 else "highest"

    @contextmanager
    def active(self) -> Iterator[None]:
        """Around a step's rendering and backward pass."""
        precision = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision(self._precision)
        for name, branch in self._branches.items():
            setattr(self.decoders, name, branch)
        try:
            yield
        finally:
            for name in self._branches:
                delattr(self.decoders, name)
            torch.set_float32_matmul_precision(precision)


def can_compile() -> bool:
    """Whether torch.compile has what it needs for CUDA here: Triton, and a C compiler for its launchers."""
    has_triton = importlib.util.find_spec("triton") is not None
    return has_triton and any(shutil.which(name) for name in (os.environ.get("CC", "cc"), "gcc", "clang"))
