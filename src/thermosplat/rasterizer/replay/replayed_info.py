"""``info`` of a replayed call: right whenever it is read, also after later calls.

What a graph wrote was copied by the call, all in one block, of which tensors are made when they are read. Those that
are differentiable in a plain call are here, too; their gradient is that of a plain call, made when it is asked for.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.rasterizer.info import InfoTensors, RasterizationInfo, TiledSize, rasterization_info

Plain = Callable[[Sequence[Tensor]], Any]
"""The same call as it is without graphs, of other tensors."""


class InfoLayout(NamedTuple):
    """What is the same for all replays of a captured call."""

    constants: Mapping[str, Any]
    """Entries that are no tensors."""
    keys: tuple[str, ...]
    """The others, without means2d."""
    size: TiledSize
    tensors: tuple[tuple[str, torch.Size, torch.dtype], ...]
    """What lies in the block: fields of ``InfoTensors``, with shape and type."""
    differentiable: frozenset[str]
    """Keys whose tensors need gradients in a plain call; means2d is a node's own."""


class CopiedInfo:
    """Reads the entries of one call.

    Args:
        layout: Of the captured call.
        parts: Of the block, in the layout's order, each flat float32, whose bits may be whole numbers.
        means2d: [..., C, N, 2].
        plain: The call without graphs.
        tensors: Of the call.
    """

    def __init__(
        self, layout: InfoLayout, parts: Sequence[Tensor], means2d: Tensor, plain: Plain, tensors: Sequence[Tensor]
    ) -> None:
        self._layout, self._parts, self._means2d, self._plain, self._tensors = layout, parts, means2d, plain, tensors
        self._made: RasterizationInfo | None = None

    def __call__(self, key: str) -> Any:
        """The value of a key."""
        if self._made is None:
            self._made = self._make()
        value = self._made[key]
        if key == "flatten_ids":  # behind the pairs is room for more
            return value[: int(self._tile_offsets[-1])]
        if key not in self._layout.differentiable:
            return value
        with torch.enable_grad():
            return Recomputed.apply([value], key, self._plain, self._means2d.grad_fn, *self._tensors)

    def _make(self) -> RasterizationInfo:
        fields: dict[str, Tensor | None] = dict.fromkeys(InfoTensors._fields)
        for part, (name, shape, dtype) in zip(self._parts, self._layout.tensors, strict=True):
            fields[name] = part.view(dtype).view(shape)
        fields["means2d"] = self._means2d
        roots = fields["roots"]
        if roots is not None:
            fields["roots"] = roots[..., :3]
        made = InfoTensors(**fields)  # type: ignore[arg-type]
        self._tile_offsets = made.tile_offsets
        return rasterization_info(made, self._layout.size, self._count_nonfinite)

    def _count_nonfinite(self) -> int:
        with torch.no_grad():
            return int(self._plain(self._tensors)[-1]["num_nonfinite"])


def replayed_info(
    layout: InfoLayout, parts: Sequence[Tensor], means2d: Tensor, plain: Plain, tensors: Sequence[Tensor]
) -> RasterizationInfo:
    """The dictionary; arguments are those of ``CopiedInfo``."""
    read = CopiedInfo(layout, parts, means2d, plain, tensors)
    values = {**layout.constants, "means2d": means2d}
    return RasterizationInfo(values, {key: partial(read, key) for key in layout.keys})


class Recomputed(torch.autograd.Function):
    """An entry with the values that a call had, and the gradient of the plain call."""

    @staticmethod
    def forward(ctx: Any, value: list[Tensor], key: str, plain: Plain, node: Any, *tensors: Tensor) -> Tensor:
        ctx.key, ctx.plain, ctx.node = key, plain, node
        return value.pop().detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        needs = ctx.needs_input_grad[4:]
        # the node's own: torch refuses them where they were changed since the call, or let go of
        leaves = [
            tensor.detach().requires_grad_(needed) for tensor, needed in zip(ctx.node.saved_tensors, needs, strict=True)
        ]
        with torch.enable_grad():
            value = ctx.plain(leaves)[-1][ctx.key]
        wanted = [leaf for leaf in leaves if leaf.requires_grad]
        found = iter(torch.autograd.grad(value, wanted, gradient, allow_unused=True))
        return None, None, None, None, *[next(found) if needed else None for needed in needs]
