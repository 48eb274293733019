"""The decoders' two branches as Warp kernels: activations of a pixel do not leave the chip.

PyTorch writes every layer's activations to memory and reads them back for the gradient; at 64 channels per pixel that
traffic, not the arithmetic, is what decoding costs. ``warp_kernels.decoding.decoder_networks``
says how a warp keeps them.

The networks are those of ``scene.decoders`` with two shared layers and a modulation; ``teams`` says for which sizes
there are kernels, and which of them a device has room for.
"""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import strided_view, view, warp_device_of
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.decoding.decoder_adjoint import decode_adjoint_kernel
from warp_kernels.decoding.decoder_memory import TEAMS, THREADS, layout_of, padded_inputs
from warp_kernels.decoding.decoder_networks import HIDDEN, decode_kernel
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.launching import launch_again

RESERVED = 1024
"""Bytes of a block's shared memory that Warp takes for itself: four a thread. The 1 KB a block that CUDA reserves is no
part of what it allows (CUDA C++ Programming Guide, "Shared Memory" of 8.x: 100 KB a multiprocessor, 99 KB a block)."""

OLDEST = 80
"""Compute capability (8.0) from which there are the matrix products the kernels use."""


def teams(device: torch.device, hidden: int, features: int) -> tuple[int, ...]:
    """How many warps may share 16 pixels in the adjoint, where there are kernels for networks of a shape.

    Args:
        hidden: Channels of hidden layers.
        features: Channels of the features.

    Returns:
        Of ``TEAMS`` those for which the device allows a block enough shared memory, the quickest first; none where the
        device, or the one that Warp compiles for, is too old or the kernels are written for other shapes.
    """
    inputs = padded_inputs(features)
    if device.type != "cuda" or hidden not in HIDDEN or inputs is None:
        return ()
    on = warp_device_of(device)
    # beside an older GPU, and for one that it does not know yet, Warp may write PTX of a lower capability
    if on.get_cuda_compile_arch() < OLDEST:
        return ()
    return teams_within(hidden, inputs, on.max_shared_memory_per_block)


def teams_within(hidden: int, inputs: int, shared_memory: int) -> tuple[int, ...]:
    """As ``teams``, of a device that allows a block so much shared memory.

    Args:
        hidden: Channels of hidden layers, of ``HIDDEN``.
        inputs: Columns of features, of ``INPUTS``.
        shared_memory: Most a block may ask for [bytes]: 101,376 on consumer GPUs (compute capability 8.6, 8.9, 12.0),
            166,912 on 8.0, 232,448 on 9.0 (CUDA C++ Programming Guide, "Technical Specifications").
    """
    return tuple(team for team in TEAMS if layout_of(hidden, True, inputs, team).size <= shared_memory - RESERVED)


def decode_branches(
    team: int, visible: Tensor | None, thermal: Tensor | None, parameters: Sequence[Tensor | None]
) -> tuple[Tensor | None, Tensor | None]:
    """Features of each branch to its image; the gradients of layers that both have are summed over both.

    Args:
        team: One of ``teams``.
        visible: Features of the modulated branch, shape [..., d]; None: it is not asked for.
        thermal: Features of the prior's own branch, shape [..., d]; None: it is not asked for.
        parameters: Weight and bias of each layer: the encoder's two, the prior's, the modulation, the head of the
            modulated branch, the head of the prior's own branch (None, None where there is none).

    Returns:
        Images in (0, 1), shape [..., channels]; None for a branch that was not asked for.
    """
    return _Branches.apply(team, visible, thermal, *parameters)


SHARED = 6
"""The first weights and biases are those of three layers that both branches have."""

RGB, THERMAL = range(10), (*range(SHARED), None, None, 10, 11)
"""Which of them a branch has, in the order of its kernels; the thermal one has no modulation."""


class _Branches(torch.autograd.Function):
    """Features [..., d] of each branch to its image [..., channels]; None for a branch that is not asked for.

    The gradients of the layers that both have are sums over the pixels of both, so one function has both.
    """

    @staticmethod
    def forward(
        ctx: Any, team: int, visible: Tensor | None, thermal: Tensor | None, *parameters: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None]:
        images = (
            None if visible is None else _decoded(visible, _of_branch(RGB, parameters)),
            None if thermal is None else _decoded(thermal, _of_branch(THERMAL, parameters)),
        )
        ctx.save_for_backward(visible, thermal, *images, *parameters)
        ctx.set_materialize_grads(False)
        ctx.team = team
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_rgb: Tensor | None, v_thermal: Tensor | None) -> tuple[Tensor | None, ...]:
        visible, thermal, rgb_image, thermal_image, *parameters = ctx.saved_tensors
        branches = [
            (visible, rgb_image, v_rgb, _of_branch(RGB, parameters)),
            (thermal, thermal_image, v_thermal, _of_branch(THERMAL, parameters)),
        ]
        sizes = [0 if v_image is None else _size(own) for *_, v_image, own in branches]
        programs = warp_device_of(parameters[0].device).sm_count
        partial = parameters[0].new_empty(programs, sum(sizes))
        v_features = [
            None if v_image is None else _decoded_adjoint(ctx.team, features, image, v_image, own, of_branch)
            for (features, image, v_image, own), of_branch in zip(branches, partial.split(sizes, 1), strict=True)
        ]
        of_rgb, of_thermal = partial.sum(0).split(sizes)
        if v_rgb is not None and v_thermal is not None:
            shared = _size(parameters[:SHARED])
            of_rgb[:shared] += of_thermal[:shared]
        v_parameters: list[Tensor | None] = [None] * len(parameters)
        for sums, places in ((of_thermal, THERMAL), (of_rgb, RGB)):  # of both, the sums with both are the last
            if len(sums) > 0:
                own = [k for k in places if k is not None]
                pieces = sums.split([parameters[k].numel() for k in own])
                for k, piece in zip(own, pieces, strict=True):
                    v_parameters[k] = piece.view(parameters[k].shape)
        return None, *v_features, *v_parameters


def _of_branch(places: Sequence[int | None], parameters: Sequence[Tensor | None]) -> list[Tensor | None]:
    """A branch's weights and biases."""
    return [None if k is None else parameters[k] for k in places]


def _size(parameters: Sequence[Tensor | None]) -> int:
    """Numbers of all of them."""
    return sum(0 if parameter is None else parameter.numel() for parameter in parameters)


def _decoded(features: Tensor, parameters: Sequence[Tensor | None]) -> Tensor:
    """A branch's image."""
    pixels, weights = _pixels(features), _views(parameters)
    image = features.new_empty(*features.shape[:-1], parameters[-1].shape[0])  # type: ignore[union-attr]
    programs = 2 * warp_device_of(features.device).sm_count
    inputs = [strided_view(pixels), *weights, strided_view(_flat(image))]
    _launch(decode_kernel(*_shape(parameters)), programs, inputs, features.device)
    return image


def _decoded_adjoint(
    team: int,
    features: Tensor,
    image: Tensor,
    v_image: Tensor,
    parameters: Sequence[Tensor | None],
    partial: Tensor,
) -> Tensor:
    """Gradient of a branch's features; ``partial`` [programs, numbers] gets those of the parameters, to be summed."""
    v_features, v_image = features.new_empty(features.shape), v_image.contiguous()
    largest = torch.linalg.vector_norm(v_image, torch.inf)
    images = [strided_view(_flat(image)), strided_view(_flat(v_image)), view(largest, wp.float32, 1)]
    outputs = [strided_view(_flat(v_features)), strided_view(partial)]
    inputs = [strided_view(_pixels(features)), *images, *_views(parameters), *outputs]
    _launch(decode_adjoint_kernel(*_shape(parameters), team), len(partial), inputs, features.device)
    return v_features


def _shape(parameters: Sequence[Tensor | None]) -> tuple[int, bool, int]:
    """Channels of hidden layers, whether there is a modulation, and columns of features."""
    hidden, features = parameters[0].shape  # type: ignore[union-attr]
    return hidden, parameters[6] is not None, padded_inputs(features)


def _launch(kernel: wp.Kernel, programs: int, inputs: list[Any], device: torch.device) -> None:
    with launches_on_torch_stream(device):
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
