"""Torch's memory as Warp's arrays (streams.py shares the device with it).

Torch owns every tensor that outlives a call. A flat array of Warp may be a tensor of any shape here: those that users
see are made in the shape they see.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.kernel_cache import start_warp
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.machinery.loading import made_once

Backward = TypeVar("Backward", bound=Callable[..., Any])

LONGEST = 2**30
"""Most numbers of a tensor that kernels number one by one, with 32 bits; see ``numbered_parts``."""

SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
"""Torch dtypes the kernels run in, and Warp's names for them."""


@made_once
def warp_device_of(device: torch.device) -> wp.Device:
    """Warp's device of torch's."""
    start_warp()
    return wp.device_from_torch(device)


class Kinds(NamedTuple):
    """Warp's types for the numbers of a torch dtype."""

    scalar: Any
    vec2: Any
    vec3: Any
    vec4: Any
    vec6: Any
    mat33: Any
    mat44: Any


@made_once
def kinds_of(dtype: torch.dtype) -> Kinds:
    """The types for ``torch.float32`` or ``torch.float64``."""
    scalar = SCALARS[dtype]
    vectors = (wp.types.vector(k, scalar) for k in (2, 3, 4, 6))
    return Kinds(scalar, *vectors, *(wp.types.matrix((k, k), scalar) for k in (3, 4)))


@made_once
def vector_of(length: int, dtype: torch.dtype) -> Any:
    """The type of a vector of so many numbers of a torch dtype."""
    return wp.types.vector(length, SCALARS[dtype])


def view(tensor: Tensor, kind: Any, *shape: int) -> ArrayView:
    """A torch tensor's memory as an array for the launches of warp_kernels.

    Args:
        tensor: contiguous; the array does not keep it alive.
        shape: extents; none: one dimension.
    """
    shape = shape or (tensor.numel() // getattr(kind, "_length_", 1),)
    return ArrayView(tensor.data_ptr(), shape, kind, warp_device_of(tensor.device))


def numbered_parts(tensor: Tensor) -> Sequence[Tensor]:
    """A tensor's numbers for kernels that number them one by one: the tensor, or flat parts where they are too many.

    Returns:
        Tensors on its memory, in order, of at most ``LONGEST`` numbers each.
    """
    return (tensor,) if tensor.numel() <= LONGEST else tensor.view(-1).split(LONGEST)


def strided_view(tensor: Tensor) -> ArrayView:
    """A torch tensor's numbers as an array of its shape and strides, which keeps it alive.

    Args:
        tensor: float32 or float64, of any strides.
    """
    size = tensor.element_size()
    # contiguous ones have the strides of their shape, whatever torch says of dimensions of size 1
    strides = None if tensor.is_contiguous() else tuple(stride * size for stride in tensor.stride())
    kind = SCALARS[tensor.dtype]
    return ArrayView(tensor.data_ptr(), tuple(tensor.shape), kind, warp_device_of(tensor.device), tensor, strides)


def given_view(gradient: Tensor, kind: Any, *shape: int) -> ArrayView:
    """A gradient that autograd brought, as ``view``, made contiguous and kept alive by the array.

    The other arguments are those of ``view``.

    Args:
        gradient: any strides.
    """
    gradient = gradient.contiguous()
    array = view(gradient, kind, *shape)
    array.owner = gradient
    return array


def lend(array: ArrayView, gradient: Tensor | None) -> ArrayView:
    """Gives an array a gradient to read, made contiguous and kept alive.

    Args:
        array: an output of a step.
        gradient: what autograd brought; None stands for zeros.
    """
    if gradient is not None:
        gradient = gradient.contiguous()
        array.gradient_at(gradient.data_ptr(), gradient)
    return array


def take_back(*arrays: ArrayView | None) -> None:
    """Takes gradients from arrays that outlive the adjoint which read or wrote them.

    Args:
        *arrays: inputs and outputs of a step; None for one that it does not have.
    """
    for array in arrays:
        if array is not None:
            array.grad = None


def kept(ctx: Any) -> tuple[Any, ...]:
    """The tensors that a function saved; its arrays of their memory, ``ctx.arrays``, are of that memory again.

    There is an array, which does not keep the memory alive, or None for each tensor, or None. What is saved may come
    back elsewhere: from the host, or recomputed (torch.utils.checkpoint).

    Args:
        ctx: of an autograd function.

    Returns:
        The tensors in their order; to be held while the arrays are read: where they were recomputed, nobody else holds
        them.
    """
    tensors: tuple[Any, ...] = ctx.saved_tensors
    for array, tensor in zip(ctx.arrays, tensors, strict=True):
        if tensor is not None:
            ptr = tensor.data_ptr()
            if ptr != array.ptr:
                array.place(ptr)
    return tensors


def once_in_turns(backward: Backward) -> Backward:
    """Lets threads that differentiate one scene do so one after the other, and refuses second derivatives.

    Its functions share arrays that carry gradients while an adjoint runs, and a launch lets other threads go on.

    Args:
        backward: of an autograd function whose ``ctx.turns`` is the scene's lock.

    Returns:
        It, holding that lock.
    """
    refusing_another = once_differentiable(backward)

    @functools.wraps(backward)
    def in_turn(ctx: Any, *gradients: Tensor | None) -> Any:
        with ctx.turns:
            if torch.is_grad_enabled():  # somebody may want a second derivative
                return refusing_another(ctx, *gradients)
            return backward(ctx, *gradients)

    return cast("Backward", in_turn)
