"""A backward pass visits what an image was made by, and no gradient changes by it."""

from typing import Any

import torch
from torch import Tensor

from thermosplat.training.sharing.calls import TakingPart


class Noted(torch.autograd.Function):
    """Notes the gradient that it was visited with, as an exchange between ranks does its part then."""

    visits: "list[Tensor | None]" = []  # noqa: RUF012  (a record of the test)

    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        ctx.set_materialize_grads(False)
        return image.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor | None) -> Tensor | None:
        Noted.visits.append(gradient)
        return gradient


def test_images_that_nothing_is_asked_of_are_visited() -> None:
    """A rank whose frame has no view for a call sends its gradients nonetheless, which are none."""
    Noted.visits.clear()
    values = torch.ones(3, 3, requires_grad=True)
    zero = TakingPart.apply(Noted.apply(values), Noted.apply(values))
    assert zero.item() == 0
    zero.backward()
    assert Noted.visits == [None, None]
    assert values.grad is None


def test_gradients_of_other_losses_stay() -> None:
    """To the last bit, and without a sum of images of zeros."""
    Noted.visits.clear()
    values = torch.rand(4, 4, requires_grad=True)
    image = Noted.apply(values)
    torch.autograd.backward([image.square().sum(), TakingPart.apply(image)])
    (visit,) = Noted.visits
    assert visit is not None
    assert torch.equal(values.grad, 2 * values.detach())
