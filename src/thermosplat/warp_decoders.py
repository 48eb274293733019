"""The decoders' two branches as Warp kernels: activations of a pixel do not leave the chip.

PyTorch writes every layer's activations to memory and reads them back for the gradient; at 64 channels a pixel that
traffic, not the arithmetic, is what decoding costs. ``warp_kernels.decoder_networks`` says how a warp keeps them.

The networks are those of decoders.py with two shared layers; ``teams`` says for which there are kernels, and which of
them a device has room for.
"""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.decoders import Decoders
from thermosplat.warp_bridge import strided_view, view, warp_device_of
from thermosplat.warp_streams import launches_on_torch_stream
from warp_kernels.array_views import ArrayView
from warp_kernels.decoder_adjoint import decode_adjoint_kernel
from warp_kernels.decoder_memory import NARROW, TEAMS, THREADS, layout_of
from warp_kernels.decoder_networks import HIDDEN, decode_kernel
from warp_kernels.launching import launch_again

RESERVED = 2048
"""Bytes of a block's shared memory that Warp takes for itself and CUDA adds."""

OLDEST = (8, 0)
"""Compute capability from which there are the matrix products the kernels use."""


def teams(decoders: Decoders) -> tuple[int, ...]:
    """How many warps may share 16 pixels in the adjoint, where there are kernels for decoders.

    Args:
        decoders: Any of that class.

    Returns:
        Of ``TEAMS`` those for which the device of the decoders allows a block enough shared memory, the quickest first;
        none where the device is too old or the decoders have another shape than the kernels are written for.
    """
    device = next(decoders.parameters()).device
    if device.type != "cuda" or torch.cuda.get_device_capability(device) < OLDEST:
        return ()
    if decoders.modulation is None or len(decoders.shared_encoder) != 4:  # two layers and their activations
        return ()
    hidden, dim = next(decoders.shared_encoder.parameters()).shape
    if hidden not in HIDDEN or dim >= NARROW:
        return ()
    return teams_within(hidden, warp_device_of(device).max_shared_memory_per_block)


def teams_within(hidden: int, shared_memory: int) -> tuple[int, ...]:
    """As ``teams``, of a device that allows a block so much shared memory.

    Args:
        hidden: Channels of hidden layers, of ``HIDDEN``.
        shared_memory: Most a block may ask for [bytes]: 101,376 on consumer GPUs (compute capability 8.6, 8.9, 12.0),
            166,912 on 8.0, 232,448 on 9.0 (CUDA C++ Programming Guide, "Technical Specifications").
    """
    return tuple(team for team in TEAMS if layout_of(hidden, True, team).size <= shared_memory - RESERVED)


class FusedDecoders:
    """The branches of ``Decoders`` by fused kernels; parameters stay where they are.

    Args:
        decoders: Decoders that have ``teams``, on a CUDA device.
        team: One of them; None for the quickest.
    """

    def __init__(self, decoders: Decoders, team: int | None = None) -> None:
        self.decoders = decoders
        self.team = teams(decoders)[0] if team is None else team

    def rgb(self, visible_features: Tensor) -> Tensor:
        """As ``Decoders.rgb``."""
        d = self.decoders
        modulation, head = _parameters(d.modulation), _parameters(d.rgb_head)
        return _Branch.apply(visible_features, self.team, *self._shared(), *modulation, *head)

    def thermal(self, thermal_features: Tensor) -> Tensor:
        """As ``Decoders.thermal``."""
        if self.decoders.thermal_head is None:
            raise ValueError("These decoders were made with thermal_channels=0; they have no thermal image.")
        head = _parameters(self.decoders.thermal_head)
        return _Branch.apply(thermal_features, self.team, *self._shared(), None, None, *head)

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
    def forward(ctx: Any, features: Tensor, team: int, *parameters: Any) -> Tensor:
        pixels, weights = _pixels(features), _views(parameters)
        image = features.new_empty(*features.shape[:-1], parameters[-1].shape[0])
        kernel = decode_kernel(*_shape(parameters))
        programs = 2 * warp_device_of(features.device).sm_count
        with launches_on_torch_stream(features.device):
            _launch(kernel, programs, [strided_view(pixels), *weights, strided_view(_flat(image))], features.device)
        ctx.save_for_backward(features, image, *parameters)
        ctx.team = team
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor) -> tuple[Tensor | None, ...]:
        features, image, *parameters = ctx.saved_tensors
        pixels, weights = _pixels(features), _views(parameters)
        v_features, v_image = features.new_empty(features.shape), v_image.contiguous()
        largest = torch.linalg.vector_norm(v_image, torch.inf)
        sizes = [0 if parameter is None else parameter.numel() for parameter in parameters]
        kernel = decode_adjoint_kernel(*_shape(parameters), ctx.team)
        programs = warp_device_of(features.device).sm_count
        partial = features.new_empty(programs, sum(sizes))
        with launches_on_torch_stream(features.device):
            images = [strided_view(_flat(image)), strided_view(_flat(v_image)), view(largest, wp.float32, 1)]
            outputs = [strided_view(_flat(v_features)), strided_view(partial)]
            _launch(kernel, programs, [strided_view(pixels), *images, *weights, *outputs], features.device)
        sums = partial.sum(0).split(sizes)
        v_parameters = [
            None if parameter is None else total.view(parameter.shape)
            for parameter, total in zip(parameters, sums, strict=True)
        ]
        return v_features, None, *v_parameters


def _shape(parameters: Sequence[Tensor | None]) -> tuple[int, bool]:
    """Channels of hidden layers, and whether there is a modulation."""
    return parameters[0].shape[0], parameters[6] is not None  # type: ignore[union-attr]


def _launch(kernel: wp.Kernel, programs: int, inputs: list[Any], device: torch.device) -> None:
    launch_again(kernel, (programs, THREADS), [programs, *inputs], warp_device_of(device), THREADS)


def _flat(tensor: Tensor) -> Tensor:
    return tensor.view(-1, tensor.shape[-1])


def _pixels(features: Tensor) -> Tensor:
    """[..., d] as [pixels, d] on the same memory where the channels lie side by side, as in a slice of a render."""
    rows = features.reshape(-1, features.shape[-1]) if features.is_contiguous() else features.flatten(0, -2)
    return rows if rows.stride(1) == 1 else rows.contiguous()


def _views(parameters: Sequence[Tensor | None]) -> list[ArrayView]:
    """Parameters for the kernels; where there is no modulation they are given the first layer, and do not read it."""
    given = [parameters[k % 2] if value is None else value for k, value in enumerate(parameters)]
    return [view(value.detach(), wp.float32, *value.shape) for value in given]  # type: ignore[union-attr]
