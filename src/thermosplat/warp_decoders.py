"""The decoders' two branches as Warp kernels: activations of a pixel do not leave the chip.

PyTorch writes every layer's activations to memory and reads them back for the gradient; at 64 channels a pixel that
traffic, not the arithmetic, is what decoding costs. ``warp_kernels.decoder_networks`` says how a warp keeps them.

The networks are those of decoders.py with two shared layers; ``fits`` says for which there are kernels, and on which
devices.
"""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.decoders import Decoders
from thermosplat.warp_bridge import view, warp_device_of
from thermosplat.warp_streams import on_torch_stream
from warp_kernels.array_views import ArrayView
from warp_kernels.decoder_memory import NARROW, THREADS, layout_of
from warp_kernels.decoder_networks import HIDDEN, decoder_kernels
from warp_kernels.launching import launch_again

RESERVED = 2048
"""Bytes of a block's shared memory that Warp takes for itself and CUDA adds."""

OLDEST = (8, 0)
"""Compute capability from which there are the matrix products the kernels use."""


def fits(decoders: Decoders) -> bool:
    """Whether decoders have the shape these kernels are written for, and their device what they need.

    Args:
        decoders: Any of that class.
    """
    device = next(decoders.parameters()).device
    if device.type != "cuda" or torch.cuda.get_device_capability(device) < OLDEST:
        return False
    if decoders.modulation is None or len(decoders.shared_encoder) != 4:  # two layers and their activations
        return False
    hidden, dim = next(decoders.shared_encoder.parameters()).shape
    if hidden not in HIDDEN or dim >= NARROW:
        return False
    return layout_of(hidden, True).size <= warp_device_of(device).max_shared_memory_per_block - RESERVED


class FusedDecoders:
    """The branches of ``Decoders`` by fused kernels; parameters stay where they are.

    Args:
        decoders: Decoders that ``fits``, on a CUDA device.
    """

    def __init__(self, decoders: Decoders) -> None:
        self.decoders = decoders

    def rgb(self, visible_features: Tensor) -> Tensor:
        """As ``Decoders.rgb``."""
        d = self.decoders
        return _Branch.apply(visible_features, *self._shared(), *_parameters(d.modulation), *_parameters(d.rgb_head))

    def thermal(self, thermal_features: Tensor) -> Tensor:
        """As ``Decoders.thermal``."""
        if self.decoders.thermal_head is None:
            raise ValueError("These decoders were made with thermal_channels=0; they have no thermal image.")
        return _Branch.apply(thermal_features, *self._shared(), None, None, *_parameters(self.decoders.thermal_head))

    def both(self, visible_features: Tensor, thermal_features: Tensor) -> tuple[Tensor, Tensor]:
        """As ``Decoders.both``."""
        return self.rgb(visible_features), self.thermal(thermal_features)

    def _shared(self) -> list[Tensor]:
        d = self.decoders
        return [*_parameters(d.shared_encoder[0]), *_parameters(d.shared_encoder[2]), *_parameters(d.thermal_prior[0])]


def _parameters(layer: Any) -> tuple[Tensor, Tensor]:
    return layer.weight, layer.bias


class _Branch(torch.autograd.Function):
    """Features [..., d] to an image [..., channels]; with a modulation the RGB branch, without it the thermal one."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, *parameters: Any) -> Tensor:
        pixels, weights = _pixels(features), _views(parameters)
        image = features.new_empty(*features.shape[:-1], parameters[-1].shape[0])
        kernel, _ = _kernels(parameters)
        programs = 2 * _multiprocessors(features.device)
        with on_torch_stream(features.device):
            _launch(kernel, programs, [_rows(pixels), *weights, _rows(_flat(image))], features.device)
        ctx.save_for_backward(features, image, *parameters)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor) -> tuple[Tensor | None, ...]:
        features, image, *parameters = ctx.saved_tensors
        pixels, weights = _pixels(features), _views(parameters)
        v_features, v_image = features.new_empty(features.shape), v_image.contiguous()
        largest = torch.linalg.vector_norm(v_image, torch.inf)
        sizes = [0 if parameter is None else parameter.numel() for parameter in parameters]
        _, kernel = _kernels(parameters)
        programs = _multiprocessors(features.device)
        partial = features.new_empty(programs, sum(sizes))
        with on_torch_stream(features.device):
            images = [_rows(_flat(image)), _rows(_flat(v_image)), view(largest, wp.float32, 1)]
            outputs = [_rows(_flat(v_features)), _rows(partial)]
            _launch(kernel, programs, [_rows(pixels), *images, *weights, *outputs], features.device)
        sums = partial.sum(0).split(sizes)
        v_parameters = [
            None if parameter is None else total.view(parameter.shape)
            for parameter, total in zip(parameters, sums, strict=True)
        ]
        return v_features, *v_parameters


def _kernels(parameters: Sequence[Tensor | None]) -> tuple[wp.Kernel, wp.Kernel]:
    return decoder_kernels(parameters[0].shape[0], parameters[6] is not None)  # type: ignore[union-attr]


def _launch(kernel: wp.Kernel, programs: int, inputs: list[Any], device: torch.device) -> None:
    launch_again(kernel, (programs, THREADS), [programs, *inputs], warp_device_of(device), THREADS)


def _multiprocessors(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count


def _flat(tensor: Tensor) -> Tensor:
    return tensor.view(-1, tensor.shape[-1])


def _pixels(features: Tensor) -> Tensor:
    """[..., d] as [pixels, d] on the same memory where the channels lie side by side, as in a slice of a render."""
    rows = features.reshape(-1, features.shape[-1]) if features.is_contiguous() else features.flatten(0, -2)
    return rows if rows.stride(1) == 1 else rows.contiguous()


def _rows(tensor: Tensor) -> ArrayView:
    """A tensor [rows, columns], columns side by side, for the kernels."""
    size = tensor.element_size()
    strides = (tensor.stride(0) * size, size)
    device = warp_device_of(tensor.device)
    return ArrayView(tensor.data_ptr(), tuple(tensor.shape), wp.float32, device, None, strides)


def _views(parameters: Sequence[Tensor | None]) -> list[ArrayView]:
    """Parameters for the kernels; where there is no modulation they are given the first layer, and do not read it."""
    given = [parameters[k % 2] if value is None else value for k, value in enumerate(parameters)]
    return [view(value.detach(), wp.float32, *value.shape) for value in given]  # type: ignore[union-attr]
