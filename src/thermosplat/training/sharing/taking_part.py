"""A loss that is zero, and lets every backward pass make the exchanges that other ranks wait for."""

from typing import Any

import torch
from torch import Tensor


class TakingPart(torch.autograd.Function):
    """Depends on images without a gradient to them: autograd visits what made them, and adds nothing to it."""

    @staticmethod
    def forward(ctx: Any, *images: Tensor) -> Tensor:
        """Zero, a scalar.

        Args:
            ctx: What the backward pass reads.
            *images: Of all renderings that other ranks take part in.
        """
        return images[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """No gradients."""
        return (None,) * len(ctx.needs_input_grad)
