"""A matrix divided over hosts, each of which makes its own cells."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from thermosplat.errors import UserError

Item = TypeVar("Item")


@dataclass(frozen=True)
class Shard:
    """One of several parts."""

    number: int
    """From 1."""
    parts: int

    def of(self, items: Sequence[Item]) -> list[Item]:
        """This part's items: the parts are disjoint, together all, and differ by at most one in their number.

        Each round of the parts starts at another one, so that none gets the same method of every scene.

        Args:
            items: All of them, in an order that every host finds.
        """
        turns = ((place + place // self.parts) % self.parts for place in range(len(items)))
        return [item for item, part in zip(items, turns) if part == self.number - 1]


def parse_shard(text: str | None) -> Shard:
    """What ``--shard`` says; without it the only part.

    Args:
        text: As "2/8".

    Raises:
        UserError: It is no part of that many.
    """
    if text is None:
        return Shard(1, 1)
    found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise UserError(
            f"--shard must be a part and the number of parts, found {text!r}.", "The second of eight: --shard 2/8"
        )
    return Shard(int(found[1]), int(found[2]))
