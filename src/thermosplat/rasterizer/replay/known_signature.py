"""What is known of calls of one signature: how often it came, where tensors lie, what was captured."""

import weakref

import torch

from thermosplat.rasterizer.pair_capacity import SPARE, PairCapacity
from thermosplat.rasterizer.replay.call_signature import Call
from thermosplat.rasterizer.replay.captured_call import CapturedCall

BOUND_BYTES = 2**20
"""Tensors from this size on are read where they lie if that is always the same place; smaller ones are copied."""

COPY_EVERY = 16
"""Replays from one copy of large info that somebody holds to the next; between them such a call is plain."""

MANY_PAIRS = 2**20
"""From so many pairs on the time of their sort counts, and it is of the whole room."""

SPARE_OF_MANY = 1.03125
"""Room over so many pairs, as a factor, until a replay had more: then the views differ, and it is ``SPARE``."""


class KnownSignature:
    """What is known of the calls of one signature."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        with torch.inference_mode(False):  # it will count outside that mode, too
            self.needed = PairCapacity(device)
        self.seen = 0
        self.refused = False
        self.info_is_large = False
        self.info_copied_at = -COPY_EVERY
        self.has_outgrown = False
        self.places: list[int] = []
        self.moving: set[int] = set()
        self.free: list[CapturedCall] = []
        self.captured: list[weakref.ref[CapturedCall]] = []
        self.bytes = 0
        self.replays = 0
        self.used = 0
        self.behind: frozenset[int] = frozenset()

    def note_places(self, call: Call) -> None:
        """Note where the tensors of a call lie."""
        places = [tensor.data_ptr() if tensor.is_contiguous() else 0 for tensor in call.tensors]
        self.moving |= {i for i, (now, then) in enumerate(zip(places, self.places)) if now != then or now == 0}
        self.places = places

    def bound(self, call: Call) -> list[bool]:
        """Which tensors are read where they lie."""
        return [one.nbytes >= BOUND_BYTES and i not in self.moving for i, one in enumerate(call.tensors)]

    def may_copy_info(self) -> bool:
        """Whether large info that is held is copied now, so that one who holds it for long holds no replays up."""
        may = self.replays - self.info_copied_at >= COPY_EVERY
        if may:
            self.info_copied_at = self.replays
        return may

    def most(self) -> tuple[int, int]:
        """Pairs, and Gaussians with pairs, that were seen at most."""
        return int(self.needed.most.max()), int(self.needed.most_listed.max())

    def spare(self, pairs: int) -> float:
        """Room over so many pairs, as a factor."""
        return SPARE if self.has_outgrown or pairs < MANY_PAIRS else SPARE_OF_MANY

    def drop(self) -> None:
        """Let go of what was captured; what is in flight goes when it is done."""
        self.free, self.captured, self.bytes, self.seen = [], [], 0, 0
