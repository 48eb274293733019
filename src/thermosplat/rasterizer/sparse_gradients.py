"""Gradients of the Gaussians that a call drew, without rows for the others: gsplat's ``sparse_grad``."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.errors import UserError
from thermosplat.rasterizer.call_inputs import Splats


def check_sparse_gradients(means: Tensor, *, packed: bool, distributed: bool) -> None:
    """Checks that a call may have sparse gradients. The other arguments are those of ``rasterization``.

    Args:
        means: [N, 3].

    Raises:
        UserError: gsplat has none for such a call, and neither have we.
    """
    if not packed:
        raise UserError("sparse_grad=True needs packed=True, as in gsplat.", "Leave packed out, or sparse_grad.")
    if distributed:
        raise UserError("sparse_grad=True does not go with distributed=True.", "Leave sparse_grad out.")
    if isinstance(means, Tensor) and means.dim() != 2:
        raise UserError(f"means must have shape [N, 3] with sparse_grad=True, got {list(means.shape)}: one scene.")


class VisibleRows(torch.autograd.Function):
    """A tensor [N, X] as it is; its gradient is a sparse one, of the rows that were visible.

    The gradient is dense until it is here, so that memory is saved in what comes after: the stored gradient and an
    optimizer that reads it, such as ``torch.optim.SparseAdam``.
    """

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, visible: list[Tensor]) -> Tensor:
        """The same numbers; ``visible`` holds a mask [N] by the time that the gradient comes."""
        ctx.visible = visible
        return tensor.view_as(tensor)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """The rows that were visible."""
        rows = ctx.visible[0].nonzero().squeeze(-1)
        found = torch.sparse_coo_tensor(
            rows[None], gradient[rows], gradient.shape, is_coalesced=True, check_invariants=False
        )
        return found, None


def sparse_gradients_of(splats: Splats, *, visible: list[Tensor]) -> Splats:
    """The same Gaussians, of which the gradients are sparse; what is no dense tensor stays as it is, to be refused.

    Args:
        splats: of means [N, 3], as given.
        visible: Holds a mask [N] of the rows with a gradient by the time that gradients come.
    """
    given = splats._asdict()
    for name in ("means", "quats", "scales", "covars"):
        one = given[name]
        if isinstance(one, Tensor) and one.layout is torch.strided:
            given[name] = VisibleRows.apply(one, visible)
    return Splats(**given)
