"""What makes two calls the same to a captured graph: shapes, kinds and gradients of tensors, and every other argument.

Numbers of tensors are no part of a signature. A call that is written in another way (by position, by keyword) has
another signature, which costs nothing but a second capture.
"""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import Parameter

from thermosplat.rasterizer.pair_capacity import active_pair_capacity

Place = Callable[[Tensor], Any]
"""Where a call's work is done (a device and a stream), or None where nothing may be replayed."""

_OF_PYTHON = frozenset((int, float, bool, str, type(None)))
"""Kinds whose values cannot change. 1, 1.0 and True are equal and not the same, so that kinds are in the key."""

NEVER = ("sparse_grad", "distributed", "with_eval3d", "return_normals", "rays", "ftheta_coeffs")
"""Arguments whose calls are not replayed: shapes that depend on numbers, ranks, kernels that are not host-bound."""


class Call(NamedTuple):
    """One call."""

    key: tuple[Any, ...]
    tensors: list[Tensor]
    """In the order in which they were given; of pairs both."""
    needs: list[bool]
    """Which of them need gradients, in this mode of torch's."""


def call_of(arguments: Sequence[Any], options: Mapping[str, Any], place: Place) -> Call | None:
    """The signature of a call.

    Returns:
        None where something of another kind was given, or the place says so.
    """
    recorded = torch.is_grad_enabled()
    key: list[Any] = [tuple(options)]
    tensors: list[Tensor] = []
    needs: list[bool] = []
    for given in (*arguments, *options.values()):
        if type(given) is tuple:
            key.append(len(given))
            values = given
        else:
            values = (given,)
        for value in values:
            kind = type(value)
            if kind is Tensor or kind is Parameter:
                needed = recorded and value.requires_grad
                tensors.append(value)
                needs.append(needed)
                key.append((value.shape, value.dtype, value.layout, value.get_device(), needed))
            elif kind in _OF_PYTHON or isinstance(value, Enum):
                key.append((kind, value))
            else:
                return None
    where = place(tensors[0]) if tensors else None
    if where is None or not _undisturbed(True in needs):
        return None
    key.append(where)
    return Call(tuple(key), tensors, needs)


def _undisturbed(differentiated: bool) -> bool:
    """Whether nothing looks into calls that a replay has nothing to show to."""
    return (
        active_pair_capacity() is None  # somebody measures or captures a step of their own
        and not torch._C._are_functorch_transforms_active()
        and forward_ad._current_level < 0
        and torch._C._len_torch_dispatch_stack() == 0
        and not torch.compiler.is_compiling()
        and not torch.is_autocast_enabled()
        and torch._C._get_tracing_state() is None
        # hooks on what is saved (checkpoints, offloading) see other tensors than those of a plain call
        and not (differentiated and torch._C._autograd._top_saved_tensors_default_hooks(True) is not None)
    )


def cuda_place(tensor: Tensor) -> Any:
    """The current device and stream, whose order keeps a graph's memory in order; None elsewhere and in a capture."""
    if not tensor.is_cuda or torch._C._cuda_isCurrentStreamCapturing():
        return None
    index = tensor.get_device()
    if index != torch._C._cuda_getDevice():
        return None
    return index, torch._C._cuda_getCurrentRawStream(index)


def with_tensors(
    arguments: Sequence[Any], options: Mapping[str, Any], tensors: Sequence[Any]
) -> tuple[list[Any], dict[str, Any]]:
    """A call with something in the place of each tensor.

    Args:
        tensors: What takes the tensors' places, in their order.
    """
    left = iter(tensors)

    def replaced(given: Any) -> Any:
        if isinstance(given, tuple):
            return tuple(replaced(one) for one in given)
        return next(left) if isinstance(given, Tensor) else given

    return [replaced(one) for one in arguments], {name: replaced(one) for name, one in options.items()}


def names_of_tensors(parameters: Sequence[str], arguments: Sequence[Any], options: Mapping[str, Any]) -> list[str]:
    """The name of the argument that each tensor was given for.

    Args:
        parameters: Of the function, in order.

    Returns:
        As many names as there are tensors, in their order.
    """
    given = [*zip(parameters, arguments), *options.items()]
    return [
        name
        for name, one in given
        for value in (one if isinstance(one, tuple) else (one,))
        if isinstance(value, Tensor)
    ]


def is_never_replayed(parameters: Sequence[str], arguments: Sequence[Any], options: Mapping[str, Any]) -> bool:
    """Whether a call has one of the arguments in ``NEVER``.

    Args:
        parameters: Of the function, in order.
    """
    given = dict(zip(parameters, arguments)) | dict(options)
    return any(given.get(name) is not None and given[name] is not False for name in NEVER)
