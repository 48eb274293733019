"""The two autograd nodes of a replayed call, and who may use its fixed memory meanwhile.

A plain call has a node that projects and one that blends, with ``info["means2d"]`` between them, whose gradient people
read, change and differentiate. A replayed call has the same two. What passes from one to the other lies in the fixed
memory, where the second graph reads it; it is copied where somebody could see it: the gradient of ``means2d`` once
``info["means2d"]`` was read, and all of it where torch keeps the graph, which may be differentiated by several threads.
"""

import functools
from typing import Any, cast

import torch
from torch import Tensor

from thermosplat.torch_bridge.arrays import Backward, once_in_turns


class Lease:
    """A captured call while what it rendered may still be differentiated; gives it back when that is over.

    It is over when all nodes were differentiated and torch does not keep the graph, or when the graph is dropped.

    Args:
        captured: The captured call.
        free: Where it is put then.
        nodes: How many nodes there are.
    """

    def __init__(self, captured: Any, free: list[Any], nodes: int) -> None:
        self.captured = captured
        self._held, self._free, self._nodes = [captured], free, nodes
        self._done: set[str] = set()
        self._shows_means2d = False

    def show_means2d(self) -> None:
        """Somebody reads ``info["means2d"]``, and may look at its gradient."""
        self._shows_means2d = True

    def lends(self) -> tuple[bool, bool]:
        """Whether gradients to means2d, and to the edges, may stay in the fixed memory in this backward pass."""
        once = not torch._C._autograd._get_current_graph_task_keep_graph()
        return once and not self._shows_means2d, once

    def differentiated(self, node: str) -> None:
        """One of the nodes has made its gradients."""
        if not torch._C._autograd._get_current_graph_task_keep_graph():
            self._done.add(node)
            if len(self._done) == self._nodes:
                self.end()

    def end(self) -> None:
        """Nothing of what was rendered is differentiated any more."""
        try:
            held = self._held.pop()
        except IndexError:
            return
        self._free.append(held)

    def __del__(self) -> None:
        self.end()


def never_twice(backward: Backward) -> Backward:
    """As ``once_in_turns``, and refuses every second derivative.

    A plain call does so where its own steps in torch (backgrounds, expected depths) multiply by what needs gradients;
    those are inside the graph here, and torch cannot see them.

    Args:
        backward: Of an autograd function whose ``ctx.turns`` is a lock.
    """
    in_turn = once_in_turns(backward)

    @functools.wraps(backward)
    def refusing(ctx: Any, *gradients: Tensor | None) -> Any:
        if torch.is_grad_enabled():
            gradients = tuple(None if one is None else one.detach().requires_grad_() for one in gradients)
        return in_turn(ctx, *gradients)

    return cast("Backward", refusing)


class Projected(torch.autograd.Function):
    """The call's tensors to ``means2d`` and what else the blending reads (``Recorded.edges``)."""

    @staticmethod
    def forward(ctx: Any, lease: Lease, means2d: list[Tensor], *tensors: Tensor) -> tuple[Tensor, ...]:
        captured = lease.captured
        ctx.lease, ctx.turns = lease, captured.turns
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)  # a graph reads some of them; torch says if one was changed
        shown = means2d.pop()
        if not captured.recorded.moves:
            ctx.mark_non_differentiable(shown)
        return shown, *[edge.detach() for edge in captured.recorded.edges]

    @staticmethod
    @never_twice
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        held = ctx.saved_tensors
        captured = ctx.lease.captured
        found = captured.project_backward(gradients if captured.recorded.moves else gradients[1:])
        ctx.lease.differentiated("projected")
        del held
        return None, None, *found


class Blended(torch.autograd.Function):
    """``means2d``, the edges, and the backgrounds, to the images."""

    @staticmethod
    def forward(ctx: Any, lease: Lease, images: list[Tensor], means2d: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        captured = lease.captured
        ctx.lease, ctx.turns, ctx.shown = lease, captured.turns, means2d
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(means2d, *others[len(captured.recorded.edges) :])
        given = tuple(images)
        images.clear()
        constant = [image for image, needs in zip(given, captured.recorded.differentiable, strict=True) if not needs]
        if constant:
            ctx.mark_non_differentiable(*constant)
        return given

    @staticmethod
    @never_twice
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        held = ctx.saved_tensors
        captured = ctx.lease.captured
        found, absolute = captured.blend_backward(gradients, ctx.lease.lends())
        if absolute is not None:  # as in a plain call
            earlier = getattr(ctx.shown, "absgrad", None)
            ctx.shown.absgrad = absolute if earlier is None else earlier + absolute
        ctx.lease.differentiated("blended")
        del held
        return None, None, *(found if captured.recorded.moves else (None, *found))
