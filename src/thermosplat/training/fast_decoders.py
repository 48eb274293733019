"""The decoders as training runs them: on CUDA compiled or fused, in the precision of tensor cores.

Only training steps see them like this; evaluation and rendering use the plain decoders in full float32.
"""

import importlib.util
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

import torch
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.scene.decoders import Decoders
from thermosplat.scene.spectrum_decoders import SpectrumDecoders
from thermosplat.training.fused_decoders import FusedDecoders, teams

Precision = Literal["float32", "tf32"]

Decode = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
"""``Decoders.decode``."""


class FastDecoders:
    """Swaps a compiled ``decode`` in and out of decoders.

    Args:
        decoders: The decoders.
        compiled: On CUDA, let fused kernels decode where there are some for the decoders and the precision
            (fused_decoders.py); otherwise let torch.compile, where it works, join element-wise work into few kernels,
            which takes some seconds once a size.
        precision: Of matrix products: "float32"; "tf32", which rounds their inputs to 10 bits of mantissa. Parameters,
            their updates and the images are float32 in any case.
    """

    def __init__(self, decoders: Decoders | SpectrumDecoders, *, compiled: bool, precision: Precision) -> None:
        self.decoders = decoders
        self._matmul = "highest" if precision == "float32" else "high"
        fused = _fused(decoders) if compiled and precision == "tf32" else None
        self._decode: Decode = decoders.decode if fused is None else fused.decode
        if fused is None and compiled and can_compile():
            self._decode = torch.compile(self._decode, dynamic=False)

    @contextmanager
    def active(self) -> Iterator[None]:
        """Around a step's rendering and backward pass."""
        precision = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision(self._matmul)
        self.decoders.decode = self._decode  # type: ignore[method-assign, assignment]
        try:
            yield
        finally:
            del self.decoders.decode
            torch.set_float32_matmul_precision(precision)


def fast_decoders(
    decoders: Decoders | SpectrumDecoders | None, config: TrainConfig, device: torch.device
) -> FastDecoders | None:
    """The decoders as a configuration wants them in steps; None where those are the plain ones, or there are none.

    Args:
        decoders: The model's.
        config: The whole configuration.
        device: Where they are.
    """
    if decoders is None or device.type != "cuda":
        return None
    return FastDecoders(decoders, compiled=config.compile, precision=config.decoder_precision)


def _fused(decoders: Decoders | SpectrumDecoders) -> FusedDecoders | None:
    """The decoders by fused kernels; None where there are none for them."""
    return FusedDecoders(decoders) if isinstance(decoders, Decoders) and teams(decoders) else None


def can_compile() -> bool:
    """Whether torch.compile has what it needs for CUDA here: Triton, and a C compiler for its launchers."""
    has_triton = importlib.util.find_spec("triton") is not None
    return has_triton and any(shutil.which(name) for name in (os.environ.get("CC", "cc"), "gcc", "clang"))
