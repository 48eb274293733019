"""Where torch's transforms end: torch.compile calls some functions as they are, torch.func's are refused."""

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import torch

from thermosplat.errors import UserError

Function = TypeVar("Function", bound=Callable[..., Any])


def not_compiled(function: Function) -> Function:
    """``torch.compiler.disable`` for a function, without importing the compiler, which takes longer than torch itself.

    Whoever compiles has imported it; until then there is nothing to disable.
    """

    @functools.wraps(function)
    def called(*arguments: Any, **options: Any) -> Any:
        if "torch._dynamo" not in sys.modules:
            return function(*arguments, **options)
        return disabled(function)(*arguments, **options)

    return called  # type: ignore[return-value]


def refuse_transforms() -> None:
    """Refuses calls inside of torch.func's transforms.

    Raises:
        UserError: what differentiates a call.
    """
    if torch._C._are_functorch_transforms_active():
        raise UserError(
            "Renders are differentiated by torch.autograd; torch.func's transforms (grad, vjp, jvp, jacrev, vmap) see "
            "nothing of the kernels.",
            "Use loss.backward() or torch.autograd.grad; torch.autograd.functional.jacobian gives Jacobians.",
        )


def disabled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``torch.compiler.disable`` for a function, made once. The compiler is imported."""
    if function not in DISABLED:
        DISABLED[function] = torch.compiler.disable(function)
    return DISABLED[function]


DISABLED: dict[Callable[..., Any], Callable[..., Any]] = {}
"""Disabled functions by the functions they are of."""
