"""``info`` of a replayed call: right whenever it is read, also after later calls.

What a graph wrote is copied, all in one block, when an entry is first read, or when the next call is about to write
there. Info that nobody holds by then is never copied. Entries that are differentiable in a plain call are here, too;
their gradient is that of a plain call, made when it is asked for.
"""

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from thermosplat.rasterizer.info import InfoTensors, SceneEntries, TiledSize
from thermosplat.rasterizer.packed_info import whole_entries

Plain = Callable[[Sequence[Tensor]], Any]
"""The same call as it is without graphs, of other tensors."""


class InfoLayout(NamedTuple):
    """What is the same for all replays of a captured call."""

    constants: Mapping[str, Any]
    """Entries that are no tensors."""
    keys: tuple[str, ...]
    """Of all entries."""
    is_packed: bool
    size: TiledSize
    tensors: tuple[tuple[str, torch.Size, torch.dtype], ...]
    """What lies in the fixed memory: fields of ``InfoTensors``, with shape and type."""
    handed_on: tuple[tuple[str, int, torch.Size], ...]
    """Fields that are one of the call's own tensors, as in a plain call: which one, and their shape."""
    differentiable: frozenset[str]
    """Keys whose tensors need gradients in a plain call; means2d is a node's own."""


class WrittenInfo:
    """What a replay wrote: in the fixed memory until that is needed again, then in a copy.

    Args:
        fixed: Parts in the layout's order, each flat float32, whose bits may be whole numbers.
        stream: The stream of the replay; None on the CPU.
    """

    def __init__(self, fixed: Sequence[Tensor], stream: torch.cuda.Stream | None) -> None:
        self._fixed: Sequence[Tensor] | None = fixed
        self._stream = stream
        self._copied: Sequence[Tensor] = ()
        self._turn = threading.Lock()

    @property
    def is_kept(self) -> bool:
        """Whether it has been copied."""
        return self._fixed is None

    def kept(self) -> Sequence[Tensor]:
        """The parts in memory of their own, copied once.

        Raises:
            RuntimeError: a CUDA graph is being captured, where nothing can be copied now.
        """
        with self._turn:
            if self._fixed is not None:
                self._copied, self._fixed = self._copy(self._fixed), None
            return self._copied

    def _copy(self, fixed: Sequence[Tensor]) -> Sequence[Tensor]:
        if self._stream is None:
            return _copied(fixed)
        if torch.cuda.is_current_stream_capturing():
            raise RuntimeError(
                "info of a replayed call is read for the first time while a CUDA graph is captured, when nothing can "
                "be copied. Read the entry before the capture begins, or render inside of it."
            )
        reader = torch.cuda.current_stream(self._stream.device)
        if reader == self._stream:
            return _copied(fixed)
        with torch.cuda.stream(self._stream):  # whose next replay comes after the copy
            copied = _copied(fixed)
        reader.wait_stream(self._stream)
        for part in copied:
            part.record_stream(reader)
        return copied


def _copied(fixed: Sequence[Tensor]) -> Sequence[Tensor]:
    """Copies, all in one block."""
    sizes = [len(one) for one in fixed]
    with torch.inference_mode(False), torch.no_grad():
        parts = fixed[0].new_empty(sum(sizes)).split(sizes)
        torch._foreach_copy_(parts, list(fixed))
    return parts


class ReplayedEntries:
    """The entries of one call.

    Args:
        layout: Of the captured call.
        means2d: [..., C, N, 2], of a call that is differentiated; else it is among what was written.
        plain: The call without graphs.
        show: Called when means2d is read.
    """

    are_of_ranks = False

    def __init__(
        self,
        layout: InfoLayout,
        written: WrittenInfo,
        means2d: Tensor | None,
        plain: Plain,
        tensors: Sequence[Tensor],
        show: Callable[[], None],
    ) -> None:
        self._layout, self._written, self._means2d = layout, written, means2d
        self._plain, self._tensors, self._show = plain, tensors, show

    @property
    def keys(self) -> Iterable[str]:
        """Of the entries."""
        return self._layout.keys

    def made(self, key: str) -> Any:
        """The value of one of the keys."""
        if key in self._layout.constants:
            return self._layout.constants[key]
        if key == "means2d" and self._means2d is not None:
            self._show()
            return self._means2d
        value = self._of_scene.made(key)
        if key == "flatten_ids":  # behind the pairs is room for more
            return value[: int(self._of_scene.tensors.tile_offsets[-1])]
        if key not in self._layout.differentiable:
            return value
        node = None if self._means2d is None else self._means2d.grad_fn
        with torch.enable_grad():
            return Recomputed.apply([value], key, self._plain, node, *self._tensors)

    @cached_property
    def _of_scene(self) -> SceneEntries:
        fields: dict[str, Tensor | None] = dict.fromkeys(InfoTensors._fields)
        for part, (name, shape, dtype) in zip(self._written.kept(), self._layout.tensors, strict=True):
            fields[name] = part.view(dtype)[: shape.numel()].view(shape)
        for name, which, shape in self._layout.handed_on:
            fields[name] = self._tensors[which].detach().reshape(shape)
        if self._means2d is not None:
            fields["means2d"] = self._means2d
        roots = fields["roots"]
        if roots is not None:
            fields["roots"] = roots[..., :3]
        made = InfoTensors(**fields)  # type: ignore[arg-type]
        return SceneEntries(made, self._layout.size, self._count_nonfinite)

    def _count_nonfinite(self) -> int:
        with torch.no_grad():
            return int(self._plain(self._tensors)[-1]["num_nonfinite"])


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
            value = whole_entries(ctx.plain(leaves)[-1].entries).made(ctx.key)
        wanted = [leaf for leaf in leaves if leaf.requires_grad]
        found = iter(torch.autograd.grad(value, wanted, gradient, allow_unused=True))
        return None, None, None, None, *[next(found) if needed else None for needed in needs]
