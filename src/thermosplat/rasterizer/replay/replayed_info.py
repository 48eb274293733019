"""``info`` of a replayed call: right whenever it is read, also after later calls.

What a graph wrote is copied, all in one block, when an entry is first read, or when the next call is about to write
there. Info that nobody holds by then is never copied. Entries that are differentiable in a plain call are here, too;
their gradient is that of a plain call, made when it is asked for.
"""

import threading
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
    """The others, without a means2d that is differentiated."""
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


class EntriesOfInfo:
    """Reads the entries of one call.

    Args:
        layout: Of the captured call.
        written: By the replay.
        means2d: [..., C, N, 2], of a call that is differentiated; else it is among what was written.
        plain: The call without graphs.
        tensors: Of the call.
    """

    def __init__(
        self,
        layout: InfoLayout,
        written: WrittenInfo,
        means2d: Tensor | None,
        plain: Plain,
        tensors: Sequence[Tensor],
    ) -> None:
        self._layout, self._written, self._means2d = layout, written, means2d
        self._plain, self._tensors = plain, tensors
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
        node = None if self._means2d is None else self._means2d.grad_fn
        with torch.enable_grad():
            return Recomputed.apply([value], key, self._plain, node, *self._tensors)

    def _make(self) -> RasterizationInfo:
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
        self._tile_offsets = made.tile_offsets
        return rasterization_info(made, self._layout.size, self._count_nonfinite)

    def _count_nonfinite(self) -> int:
        with torch.no_grad():
            return int(self._plain(self._tensors)[-1]["num_nonfinite"])


def replayed_info(
    layout: InfoLayout,
    written: WrittenInfo,
    means2d: Tensor | None,
    plain: Plain,
    tensors: Sequence[Tensor],
    show: Callable[[], None],
) -> RasterizationInfo:
    """The dictionary.

    Args:
        layout: As ``EntriesOfInfo``'s, like those that follow.
        written: By the replay.
        means2d: Of a call that is differentiated.
        plain: The call without graphs.
        tensors: Of the call.
        show: Called when means2d is read.
    """
    read = EntriesOfInfo(layout, written, means2d, plain, tensors)
    computed: dict[str, Callable[[], Any]] = {key: partial(read, key) for key in layout.keys}
    if means2d is not None:
        computed = {"means2d": partial(_shown, means2d, show), **computed}
    return RasterizationInfo(dict(layout.constants), computed)


def _shown(means2d: Tensor, show: Callable[[], None]) -> Tensor:
    show()
    return means2d


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
