"""Calls that come again are replayed from CUDA graphs: when a call is captured, how many are kept, and when not.

A call whose signature (``call_signature``) was seen some times is captured, and replayed from then on. A signature has
several captured calls where several renders are in flight, between forward and backward. Everything that a replay
cannot do is done by the plain call: a new signature, a tensor that lies elsewhere, a frame whose pairs have no room,
no captured call free, large ``info`` of the last call that somebody holds, another thread that captures.
"""

import functools
import inspect
import logging
import os
import sys
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, cast

import torch

from thermosplat.rasterizer.graph_breaks import DISABLED, disabled
from thermosplat.rasterizer.packed_info import whole_entries
from thermosplat.rasterizer.replay.call_signature import (
    Call,
    call_of,
    is_never_replayed,
    names_of_tensors,
)
from thermosplat.rasterizer.replay.captured_call import CapturedCall
from thermosplat.rasterizer.replay.known_signature import KnownSignature
from thermosplat.rasterizer.replay.machine import Machine
from thermosplat.rasterizer.replay.recorded_call import Subject

Function = TypeVar("Function", bound=Callable[..., Any])

SEEN = 8
"""Plain calls of a signature before it is captured. A capture takes as long as some fifty calls can save."""

PAYS = 64
"""Replays that pay for a capture. Where one has had fewer when the next signature comes, as where Gaussians are added
every few steps, the next has to be seen twice as often."""

SEEN_AT_MOST = 1024

SIGNATURES = 16
"""Signatures of which captured calls are kept; of more, the least recently used are let go."""

IN_FLIGHT = 4
"""Captured calls of one signature: so many renders may wait for their backward pass and be replayed nonetheless."""

NOTED = 256
"""Signatures that are counted, captured or not."""

MEMORY_SHARE = 1 / 24
"""Part of the device's memory that the captured calls of a function may keep."""

_log = logging.getLogger(__name__)


class Counts(NamedTuple):
    """What has happened so far to the calls of a function."""

    plain: int
    captured: int
    replayed: int
    outgrown: int
    """Replays whose pairs had no room, done again by the plain call."""
    failed: int
    """Signatures that could not be captured."""


class ReplayedCalls:
    """A function whose calls are replayed.

    Args:
        function: ``rasterization`` or ``rasterization_rgbt``.

    Attributes:
        signatures: What is known of calls, by their signature.
        turn: Held by the thread that learns or captures.
    """

    def __init__(self, function: Callable[..., Any], machine: Machine | None = None) -> None:
        self._function = function
        self._machine = Machine() if machine is None else machine
        self._parameters = list(inspect.signature(function).parameters)
        self._serves, self._place = self._machine.serves, self._machine.place
        self._counts = [0] * len(Counts._fields)
        self.turn = threading.Lock()
        self.clear()
        _all.add(self)

    def clear(self) -> None:
        """Let go of everything that is kept."""
        self.signatures: dict[Any, KnownSignature] = {}
        self._seen_at_least = SEEN
        self._last: KnownSignature | None = None
        self._clock = 0

    @property
    def counts(self) -> Counts:
        """What has happened so far."""
        return Counts(*self._counts)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """The function's result."""
        call = call_of(arguments, options, self._place) if self._serves() else None
        if call is None:
            return self._plain(arguments, options)
        signature = self.signatures.get(call.key)
        if signature is None or not signature.captured:
            return self._learned(call, arguments, options)
        free = signature.free
        try:
            captured = free.pop()
        except IndexError:  # all of them are in flight
            return self._learned(call, arguments, options)
        if not captured.is_at(call.tensors):
            free.append(captured)
            return self._learned(call, arguments, options, moved=True)
        if signature.info_is_large and captured.info_is_held() and not signature.may_copy_info():
            free.append(captured)
            return self._plain(arguments, options)
        result = captured.render(Subject(self._function, arguments, options, call, signature.behind), free)
        if result is None:
            self._counts[3] += 1
            return self._learned(call, arguments, options, outgrown=captured)
        self._clock += 1
        signature.used = self._clock
        signature.replays += 1
        self._counts[2] += 1
        return result

    def _plain(self, arguments: Sequence[Any], options: Mapping[str, Any]) -> Any:
        self._counts[0] += 1
        return self._function(*arguments, **options)

    def _learned(
        self,
        call: Call,
        arguments: Sequence[Any],
        options: Mapping[str, Any],
        *,
        moved: bool = False,
        outgrown: CapturedCall | None = None,
    ) -> Any:
        """A plain call, of which is noted what a capture needs; the last before that is followed by it."""
        turn = self.turn
        if not turn.acquire(blocking=False):
            return self._plain(arguments, options)
        try:
            signature = self.signatures.get(call.key)
            if signature is None:
                signature = self._noted(call, arguments, options)
            signature.captured = [one for one in signature.captured if one() is not None]
            if signature.refused or (len(signature.captured) >= IN_FLIGHT and not moved and outgrown is None):
                return self._plain(arguments, options)
            if moved or outgrown is not None:
                if outgrown is not None:
                    signature.has_outgrown = True
                    torch.maximum(signature.needed.most, outgrown.room.most, out=signature.needed.most)
                    torch.maximum(
                        signature.needed.most_listed, outgrown.room.most_listed, out=signature.needed.most_listed
                    )
                self._machine.wait(signature.device)
                signature.drop()
            signature.note_places(call)
            with signature.needed.step(fixed=False):
                result = self._plain(arguments, options)
            signature.seen += 1
            if signature.seen >= (2 if signature.captured else self._seen_at_least):
                self._capture(signature, Subject(self._function, arguments, options, call, signature.behind), result)
            return result
        finally:
            turn.release()

    def _noted(self, call: Call, arguments: Sequence[Any], options: Mapping[str, Any]) -> KnownSignature:
        """A signature that was not seen before."""
        if len(self.signatures) >= NOTED:
            known = self.signatures
            oldest = min(known, key=lambda key: (bool(known[key].captured), known[key].used))
            self._machine.wait(known[oldest].device)
            del known[oldest]
        signature = self.signatures[call.key] = KnownSignature(call.tensors[0].device)
        names = names_of_tensors(self._parameters, arguments, options)
        signature.behind = frozenset(i for i, name in enumerate(names) if name == "backgrounds")
        signature.refused = is_never_replayed(self._parameters, arguments, options) or not all(
            one.dtype is torch.float32
            and one.layout is torch.strided
            and one.numel() > 0
            and one.device == signature.device
            for one in call.tensors
        )
        self._clock += 1
        signature.used = self._clock
        return signature

    def _capture(self, signature: KnownSignature, subject: Subject, result: Any) -> None:
        """Captures a call, if that pays and there is memory."""
        signature.seen = 0
        device, bound = signature.device, signature.bound(subject.call)
        differentiated = True in subject.call.needs
        at_most = self._machine.copied_at_most(device, differentiated) - _copied_bytes(subject.call, bound, result)
        if at_most < 0:
            signature.refused = True
            return
        signature.info_is_large = _info_bytes(result) > at_most
        self._weigh(signature)
        before, _ = self._machine.memory(device)
        most = signature.most()
        try:
            captured = CapturedCall(subject, bound, most, signature.spare(most[0]), self._machine.recorder(device))
        except Exception:
            _log.info("a call of %s cannot be captured", self._function.__name__, exc_info=True)
            signature.refused = True
            self._counts[4] += 1
            return
        signature.bytes += max(0, self._machine.memory(device)[0] - before)
        signature.captured.append(weakref.ref(captured))
        signature.free.append(captured)
        self._clock += 1
        signature.used = self._clock
        self._counts[1] += 1
        self._make_room(signature)

    def _weigh(self, signature: KnownSignature) -> None:
        """Wait longer before a capture where the last one has not paid."""
        last, self._last = self._last, signature
        if last is not None and last is not signature:
            unpaid = last.replays < PAYS
            self._seen_at_least = min(2 * self._seen_at_least, SEEN_AT_MOST) if unpaid else SEEN

    def _make_room(self, newest: KnownSignature) -> None:
        """Let go of the least recently used ones that are too many, or keep too much memory."""
        most = MEMORY_SHARE * self._machine.memory(newest.device)[1]
        while True:
            kept = [one for one in self.signatures.values() if one.captured]
            if sum(one.bytes for one in kept) <= most and len(kept) <= SIGNATURES:
                return
            self._machine.wait(newest.device)
            least = min(kept, key=lambda one: one.used)
            least.refused = least is newest  # it is too large by itself
            least.drop()


def _copied_bytes(call: Call, bound: Sequence[bool], result: Any) -> int:
    """Bytes that a replay copies at most: tensors in, images and gradients out. Images that are blended straight into
    the caller's memory are not, but which these are is known only once the call was captured."""
    *images, info = result
    count = sum(one.nbytes for one, read in zip(call.tensors, bound, strict=True) if not read)
    shown = sum(image.nbytes for image in images if image is not None)
    count += shown
    if True in call.needs:
        # means2d; images' gradients; what passes from blending to projection; gradients of the tensors
        gaussians = _gaussians(info)
        count += 8 * gaussians
        count += shown + 4 * gaussians * (6 + sum(image.shape[-1] for image in images if image is not None))
        count += sum(one.nbytes for one, needed in zip(call.tensors, call.needs, strict=True) if needed)
    return count


def _info_bytes(result: Any) -> int:
    """Bytes that are copied where info is read, or held when the next call comes."""
    info = result[-1]
    return 45 * _gaussians(info) + 4 * len(
        whole_entries(info.entries).made("flatten_ids")
    )  # a Gaussian's: means2d, extent, depth, root, ...


def _gaussians(info: Mapping[str, Any]) -> int:
    """Gaussians of all cameras together."""
    return int(info["visible"].numel())


_all: "weakref.WeakSet[ReplayedCalls]" = weakref.WeakSet()
_public: dict[str, ReplayedCalls] = {}
_left_by_parent: list[Any] = []


def _after_fork() -> None:
    """A child process has no CUDA device: it neither uses nor destroys what its parent captured."""
    for calls in _all:
        _left_by_parent.append(calls.signatures)
        calls.turn = threading.Lock()
        calls.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)

_on = os.environ.get("THERMOSPLAT_REPLAY", "1") not in ("0", "")


def enable(on: bool = True) -> None:
    """Switches the replaying of calls on or off, in all threads.

    Args:
        on: False: every call is a plain one. What was captured is kept; see :func:`clear`.
    """
    global _on
    _on = on


def is_enabled() -> bool:
    """Whether calls are replayed."""
    return _on


def clear() -> None:
    """Lets go of all that was captured, and of its memory; it is captured anew where calls come again."""
    for calls in list(_all):
        calls.clear()


def counts() -> dict[str, Counts]:
    """What has happened so far to calls of ``rasterization`` and ``rasterization_rgbt``, by name."""
    return {name: calls.counts for name, calls in _public.items()}


def replayed(function: Function) -> Function:
    """Lets the calls of a function be replayed where they come again; torch.compile calls it as it is.

    Args:
        function: Returns images and, last, an info dictionary.
    """
    calls = _public[function.__name__] = ReplayedCalls(function)

    @functools.wraps(function)
    def called(*arguments: Any, **options: Any) -> Any:
        run: Callable[..., Any] = calls if _on else function
        if "torch._dynamo" in sys.modules:  # who compiles has imported the compiler
            run = DISABLED.get(run) or disabled(run)
        return run(*arguments, **options)

    return cast("Function", called)
