"""The decoders as training runs them: on CUDA compiled or fused, in the precision of tensor cores.

Only training steps see them like this; evaluation and rendering use the plain decoders in full float32.
"""

import importlib.util
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import torch
from torch import Tensor

from thermosplat.decoders import Decoders
from thermosplat.spectrum_decoders import SpectrumDecoders
from thermosplat.warp_decoders import FusedDecoders, teams

Precision = Literal["float32", "tf32", "bfloat16"]

BRANCHES = ("rgb", "thermal", "both")
"""Methods of Decoders that turn features into images."""


class FastDecoders:
    """Swaps compiled branches in and out of decoders.

    Args:
        decoders: The decoders.
        compiled: On CUDA, let fused kernels decode where there are some for the decoders and the precision
            (warp_decoders.py); otherwise let torch.compile, where it works, join element-wise work into few kernels,
            which takes some seconds once a size.
        precision: Of activations and matrix products: "float32"; "tf32", whose products round their inputs to 10 bits
            of mantissa; "bfloat16", which also keeps activations in 16 bits, 7 of them mantissa, and halves the
            traffic. Parameters, their updates and the images are float32 in any case.
    """

    def __init__(self, decoders: Decoders | SpectrumDecoders, *, compiled: bool, precision: Precision) -> None:
        self.decoders = decoders
        self._matmul = "highest" if precision == "float32" else "high"
        self._branches: dict[str, Callable[..., Any]] = {}
        fused = _fused(decoders) if compiled and precision == "tf32" else None
        for name in BRANCHES:
            if fused is not None:
                self._branches[name] = getattr(fused, name)
                continue
            branch = getattr(decoders, name)
            if precision == "bfloat16":
                branch = _in_bfloat16(branch)
            self._branches[name] = torch.compile(branch, dynamic=False) if compiled and can_compile() else branch

    @contextmanager
    def active(self) -> Iterator[None]:
        """Around a step's rendering and backward pass."""
        precision = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision(self._matmul)
        for name, branch in self._branches.items():
            setattr(self.decoders, name, branch)
        try:
            yield
        finally:
            for name in self._branches:
                delattr(self.decoders, name)
            torch.set_float32_matmul_precision(precision)


def _fused(decoders: Decoders | SpectrumDecoders) -> FusedDecoders | None:
    """The decoders by fused kernels; None where there are none for them."""
    return FusedDecoders(decoders) if isinstance(decoders, Decoders) and teams(decoders) else None


def _in_bfloat16(branch: Callable[..., Any]) -> Callable[..., Any]:
    """A branch under autocast, with float32 images."""

    def run(*features: Tensor) -> Tensor | tuple[Tensor, ...]:
        with torch.autocast(features[0].device.type, torch.bfloat16):
            images = branch(*features)
        return images.float() if isinstance(images, Tensor) else tuple(image.float() for image in images)

    return run


def can_compile() -> bool:
    """Whether torch.compile has what it needs for CUDA here: Triton, and a C compiler for its launchers."""
    has_triton = importlib.util.find_spec("triton") is not None
    return has_triton and any(shutil.which(name) for name in (os.environ.get("CC", "cc"), "gcc", "clang"))
