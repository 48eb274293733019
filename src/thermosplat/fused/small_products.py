"""Products of many small matrices as a torch function of one Warp kernel: what the fit of splats does on CUDA."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.torch_bridge.arrays import kinds_of, view
from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.machinery.launching import launch
from warp_kernels.training.small_products import small_product_kernels


def warp_small_products(matrices: Tensor, columns: Tensor) -> Tensor:
    """``matrices @ columns``.

    Args:
        matrices: [N, K, K]. Get no gradient.
        columns: [N, K, 3]. Receive a gradient.

    Returns:
        [N, K, 3].
    """
    return _Products.apply(matrices.contiguous(), columns.contiguous())


class _Products(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrices: Tensor, columns: Tensor) -> Tensor:
        ctx.save_for_backward(matrices)
        return _multiplied(matrices, columns, transposed=False)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_products: Tensor) -> tuple[Tensor | None, ...]:
        (matrices,) = ctx.saved_tensors
        return None, _multiplied(matrices, v_products.contiguous(), transposed=True)


def _multiplied(matrices: Tensor, columns: Tensor, *, transposed: bool) -> Tensor:
    products = torch.empty_like(columns)
    kinds = kinds_of(columns.dtype)
    number, rows, _ = columns.shape
    with launches_on_torch_stream(columns.device) as device:
        inputs = [
            view(matrices, kinds.scalar, number, rows, rows),
            view(columns, kinds.vec3, number, rows),
            view(products, kinds.vec3, number, rows),
        ]
        launch(small_product_kernels(kinds.scalar)[transposed], number * rows, inputs, device)
    return products
