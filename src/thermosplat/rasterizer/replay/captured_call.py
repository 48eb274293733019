"""One call in fixed memory: copy its tensors in, replay, and give out what belongs to the caller.

Images lie in memory of the caller's own, so that the fixed memory is free for the next call as soon as nothing is left
to be differentiated. They are blended there, or copied. ``info`` is copied when it is read, or before the next replay
if somebody still holds it. Large tensors that lay in one place in all calls seen, as parameters do, are read where they
lie; a call that brings them from elsewhere is another one (``is_at``).
"""

import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from thermosplat.rasterizer.info import Entries, RasterizationInfo
from thermosplat.rasterizer.packed_info import PackedEntries
from thermosplat.rasterizer.replay.cuda_graphs import Recorder, RoomForOne
from thermosplat.rasterizer.replay.image_launches import LaunchedByReplays, Places
from thermosplat.rasterizer.replay.nodes import Blended, Lease, Projected
from thermosplat.rasterizer.replay.recorded_call import EXTRA, GradientMemory, RecordedCall, Subject, images_of
from thermosplat.rasterizer.replay.replayed_info import ReplayedEntries, WrittenInfo

COPIED_ALONE = 2**22
"""Bytes of a tensor that is copied by itself. Small ones are copied together, by few blocks of threads."""

WARM_UPS = 2
"""Runs before anything is recorded, in which kernels are loaded."""


class CapturedCall:
    """A call, recorded.

    Args:
        subject: The call; its tensors are not kept.
        bound: Which of them are read where they lie.
        most: Pairs, and Gaussians with pairs, that were seen at most.
        spare: Room over them, as a factor.

    Attributes:
        turns: Held by whoever uses the memory of gradients.
        room: For pairs; what a replay needed is noted there.
        recorded: What is the same in every replay.
    """

    def __init__(
        self, subject: Subject, bound: Sequence[bool], most: tuple[int, int], spare: float, recorder: Recorder
    ) -> None:
        tensors = subject.call.tensors
        self.turns = threading.Lock()
        self._stream = torch.cuda.current_stream(tensors[0].device) if tensors[0].is_cuda else None
        self._last: Callable[[], WrittenInfo | None] = _nobody
        self._bound = [(i, tensors[i].data_ptr()) for i, read in enumerate(bound) if read]
        self._copied = [i for i, read in enumerate(bound) if not read]
        with torch.inference_mode(False), recorder.recording():
            self.room = RoomForOne(tensors[0].device, most, spare)
            fixed = [
                one.detach() if read else one.detach().clone(memory_format=torch.contiguous_format)
                for one, read in zip(tensors, bound, strict=True)
            ]
            self._inputs = [fixed[i] for i in self._copied]
            memory = GradientMemory([], [], [])
            straight = [_runs_straight(RecordedCall(subject, fixed, self.room, memory)) for _ in range(WARM_UPS)]
            self._places = Places()
            launcher = None
            if all(straight):
                launcher = LaunchedByReplays(tensors[0].device, recorder.leave_out, self._places)
            body = RecordedCall(subject, fixed, self.room, memory, launcher)
            written, self._forward = recorder.forward(body.forward, self.room)
            self.recorded = body.describe()
            owned = self.recorded.owned
            self._own, self._of_info = written[:owned], [one.view(torch.float32).view(-1) for one in written[owned:]]
            self._to_images, self._to_mids = memory.to_images, memory.to_mids
            if True in self.recorded.differentiable:
                self._from_blend, self._blend = recorder.backward(body.blend_backward)
                self._from_project, self._project = recorder.backward(body.project_backward)
            self._filled: set[int] = set()  # which of to_images hold something
            drawn, self._read = self.recorded.drawn, body.read_in_place()
            self._drawn = [(slot, k) for slot, k in enumerate(drawn) if k is not None]
            self._not_drawn = [k for k in range(owned) if k not in drawn]

    def is_at(self, tensors: Sequence[Tensor]) -> bool:
        """Whether what is read where it lies lies there."""
        return all(tensors[i].data_ptr() == place and tensors[i].is_contiguous() for i, place in self._bound)

    def info_is_held(self) -> bool:
        """Whether somebody holds the last call's ``info`` and has not read it, so that a replay has to copy it."""
        last = self._last()
        return last is not None and not last.is_kept

    def render(self, subject: Subject, free: list["CapturedCall"]) -> Any:
        """The call's result, from a replay.

        Args:
            subject: The call; it has the signature of what was recorded, and ``is_at`` its place.
            free: Where this is put once it may be used again: now, or when nothing can be differentiated any more.

        Returns:
            What the function returns; None where the pairs had no room, and then this is put nowhere.
        """
        tensors, recorded = subject.call.tensors, self.recorded
        last = self._last()
        if last is not None:
            last.kept()
        with torch.no_grad():
            if self._inputs:
                torch._foreach_copy_(self._inputs, [tensors[i] for i in self._copied])
            self._forward.begin()
            own: list[Any] = [None] * len(self._own)
            for slot, k in self._drawn:
                own[k] = torch.empty_like(self._own[k])
                self._places.images[slot] = own[k].data_ptr()
            self._forward.go_on()
            for k, copy in zip(self._not_drawn, _copies([self._own[k] for k in self._not_drawn]), strict=True):
                own[k] = copy
            means2d = own.pop(0) if recorded.differentiated else None
            images = images_of(recorded.views, own)
        if not self._forward.fits():
            return None
        written = WrittenInfo(self._of_info, self._stream)
        self._last = weakref.ref(written)
        show: Callable[[], None] = _nobody
        if True in recorded.differentiable:
            lease = Lease(self, free, 2 if recorded.wanted else 1)
            show = lease.show_means2d
            edges: Sequence[Tensor] = ()
            if recorded.wanted:
                means2d, *edges = Projected.apply(lease, [means2d], *tensors)
            images = Blended.apply(lease, images, means2d, *edges, *[tensors[i] for i in recorded.behind])
        else:
            free.append(self)
        entries: Entries = ReplayedEntries(recorded.layout, written, means2d, subject.with_tensors, tensors, show)
        info = RasterizationInfo(PackedEntries(entries) if recorded.layout.is_packed else entries)
        left = iter(images)
        result = [next(left) if given else None for given in recorded.given]
        for extra in left:
            info[EXTRA] = extra
        return recorded.make([*result, info])

    def blend_backward(
        self, gradients: Sequence[Tensor | None], lends: Sequence[bool]
    ) -> tuple[list[Tensor | None], Tensor | None]:
        """Gradients to ``means2d`` if it moves, to the edges and to the backgrounds; and sums of absolute ones.

        Args:
            lends: Of the gradients to ``means2d`` and to the edges, whether the fixed memory itself may be returned:
                nobody but ``project_backward`` reads it, before it is written anew.

        Returns:
            In memory of their own but for those that are lent.
        """
        given = [one for one, needed in zip(gradients, self.recorded.differentiable, strict=True) if needed]
        in_place: dict[int, Tensor] = {}  # kept until the launch that reads them
        for slot, k in enumerate(self._read):
            gradient = None if k is None else given[k]
            if gradient is not None and k is not None:
                in_place[k] = gradient = gradient.contiguous()
            self._places.gradients[slot] = None if gradient is None else gradient.data_ptr()
        self._put_to_images({k: one for k, one in enumerate(given) if one is not None and k not in in_place})
        self._blend()
        moves = self.recorded.moves
        mids: list[Tensor | None] = [
            one if lent else one.clone() for one, lent in zip(self._to_mids, lends if moves else lends[1:])
        ]
        *behind, absolute = _copies(self._from_blend)
        return [*mids, *behind], absolute

    def project_backward(self, gradients: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Gradients to the call's tensors; None for those that have none from here.

        Args:
            gradients: To ``means2d`` if it moves, and to the edges; those that were lent are in their place.
        """
        _put(self._to_mids, gradients)
        self._project()
        found: list[Tensor | None] = [None] * (len(self._bound) + len(self._copied))
        for i, gradient in zip(self.recorded.wanted, _copies(self._from_project), strict=True):
            found[i] = gradient
        return found

    def _put_to_images(self, gradients: Mapping[int, Tensor]) -> None:
        """Copies some of the images' gradients to the fixed memory; zeros stand for the others."""
        if gradients:
            torch._foreach_copy_([self._to_images[k] for k in gradients], list(gradients.values()))
        empty = self._filled - gradients.keys()
        if empty:
            torch._foreach_zero_([self._to_images[k] for k in empty])
        self._filled = set(gradients)


def _nobody() -> None:
    """Stands for info that nobody holds."""


def _runs_straight(body: RecordedCall) -> bool:
    """Runs what will be recorded. Returns whether its images are those that were blended."""
    body.forward()
    if True in body.describe().differentiable:
        body.blend_backward()
        body.project_backward()
    return body.shows_what_is_blended()


def _put(memory: Sequence[Tensor], values: Sequence[Tensor | None]) -> None:
    """Copies values to fixed memory, but those that lie there; None stands for zeros."""
    given = [
        (one, value)
        for one, value in zip(memory, values, strict=True)
        if value is not None and value.data_ptr() != one.data_ptr()
    ]
    absent = [one for one, value in zip(memory, values, strict=True) if value is None]
    if given:
        torch._foreach_copy_([one for one, _ in given], [value for _, value in given])
    if absent:
        torch._foreach_zero_(absent)


def _copies(memory: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Copies of fixed memory."""
    copies = [None if one is None else torch.empty_like(one) for one in memory]
    small: list[Tensor] = []
    of_small: list[Tensor] = []
    for one, copy in zip(memory, copies, strict=True):
        if one is None or copy is None:
            continue
        if one.nbytes >= COPIED_ALONE:
            copy.copy_(one)
        else:
            small.append(one)
            of_small.append(copy)
    if small:
        torch._foreach_copy_(of_small, small)
    return copies
