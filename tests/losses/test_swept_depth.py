"""Distances from swept depths, by hand."""

import math

import pytest
import torch

from thermosplat.losses.image_terms import swept_depth_loss


def test_mean_depth_is_drawn_to_the_target() -> None:
    """Four pixels: 2% too far, one of another surface, one unknown, one without depth. The first alone learns."""
    alpha = torch.tensor([0.8, 1.0, 1.0, 0.3], dtype=torch.float64).reshape(2, 2, 1).requires_grad_()
    target = torch.tensor([1.0, 1.0, math.nan, 1.0], dtype=torch.float64).reshape(2, 2)
    log_depth = torch.tensor([0.8 * 1.02, 2.0, 1.5, 0.3], dtype=torch.float64).reshape(2, 2, 1).requires_grad_()
    loss = swept_depth_loss(log_depth, alpha, target, 0.1)
    assert loss.item() == pytest.approx((0.02 + 0.1) / 4)
    loss.backward()
    assert log_depth.grad is not None
    assert alpha.grad is not None
    assert log_depth.grad.flatten().tolist() == pytest.approx([1 / 0.8 / 4, 0.0, 0.0, 0.0])
    # a mean is a quotient: of more opacity it is less
    assert alpha.grad.flatten().tolist() == pytest.approx([-1.02 / 0.8 / 4, 0.0, 0.0, 0.0])


def test_nothing_known() -> None:
    """Without a target the loss is zero, and so are the gradients."""
    log_depth = torch.rand(3, 4, 1, requires_grad=True)
    loss = swept_depth_loss(log_depth, torch.ones(3, 4, 1), torch.full((3, 4), math.nan), 0.1)
    loss.backward()
    assert loss.item() == 0.0
    assert log_depth.grad is not None
    assert not log_depth.grad.any()
