"""What every step does with a ``wp.Tape``: record an adjoint, and find the gradients that it reads and adds to."""

from collections.abc import Callable

import warp as wp

from warp_kernels.machinery.array_views import zeros


def gradient_of(array: wp.array) -> wp.array:
    """The gradient of an array, or zeros to read and throw away where it has none.

    Args:
        array: an input or output of a step.

    Returns:
        An array of the same shape and type.
    """
    return array.grad if array.grad is not None else zeros(array.shape, array.dtype, array.device)


def record_adjoint(tape: wp.Tape, adjoint: Callable[[], None], *arrays: wp.array) -> None:
    """Records the adjoint of a step.

    Args:
        tape: replays it in ``tape.backward()``.
        adjoint: launches the adjoint kernels, none of which records itself.
        arrays: inputs and outputs; those that already have gradients are those ``tape.zero()`` will clear.
    """
    # Warp takes one without elements for one without a gradient.
    tape.record_func(adjoint, [array for array in arrays if array.grad is not None and array.size > 0])
