"""The decoders as training runs them: on CUDA compiled or fused, in the precision of tensor cores.

Only training steps see them like this; evaluation and rendering use the plain decoders in full float32.
"""

import importlib.util
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import Literal

import torch

from thermosplat.config import TrainConfig
from thermosplat.scene.decoder import Decode, Decoder, Decoders
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.training.fused_decoders import FusedDecoders, teams

Precision = Literal["float32", "tf32"]


class FastDecoders:
    """Another way to decode, for a while.

    Attributes:
        decode: As ``Decoder.decode``.

    Args:
        decoder: Whose networks they are.
        compiled: On CUDA, let fused kernels decode where there are some for the decoders and the precision
            (fused_decoders.py); otherwise let torch.compile, where it works, join element-wise work into few kernels,
            which takes some seconds once a size.
        precision: Of matrix products: "float32"; "tf32", which rounds their inputs to 10 bits of mantissa. Parameters,
            their updates and the images are float32 in any case.
    """

    def __init__(self, decoder: Decoder, *, compiled: bool, precision: Precision) -> None:
        self._matmul = "highest" if precision == "float32" else "high"
        fused = _fused(decoder) if compiled and precision == "tf32" else None
        self.decode: Decode = decoder.decode if fused is None else fused.decode
        if fused is None and compiled and can_compile():
            self.decode = torch.compile(self.decode, dynamic=False)

    @contextmanager
    def precise(self) -> Iterator[None]:
        """Within it matrix products have the precision that was asked for."""
        precision = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision(self._matmul)
        try:
            yield
        finally:
            torch.set_float32_matmul_precision(precision)

    @contextmanager
    def active(self, formations: Formations) -> Iterator[None]:
        """Around a step's rendering and backward pass."""
        with self.precise(), formations.decoding_by(self.decode):
            yield


def fast_decoding(
    formations: Formations, config: TrainConfig, device: torch.device
) -> Callable[[], AbstractContextManager[None]]:
    """What is opened around a step so that features are decoded as a configuration wants it."""
    if formations.decoder is None or device.type != "cuda":
        return nullcontext
    fast = FastDecoders(formations.decoder, compiled=config.compile, precision=config.decoder_precision)
    return partial(fast.active, formations)


def _fused(decoder: Decoder) -> FusedDecoders | None:
    """The decoder by fused kernels; None where there are none for it."""
    return FusedDecoders(decoder) if isinstance(decoder, Decoders) and teams(decoder) else None


def can_compile() -> bool:
    """Whether torch.compile has what it needs for CUDA here: Triton, and a C compiler for its launchers."""
    has_triton = importlib.util.find_spec("triton") is not None
    return has_triton and any(shutil.which(name) for name in (os.environ.get("CC", "cc"), "gcc", "clang"))
