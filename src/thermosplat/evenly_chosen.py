"""Some of many, evenly chosen."""

from collections.abc import Sequence
from typing import TypeVar

Item = TypeVar("Item")


def evenly_chosen(items: Sequence[Item], most: int) -> list[Item]:
    """Up to ``most`` of some items, in order; both ends are among two or more."""
    if len(items) <= most:
        return list(items)
    return [items[round(place * (len(items) - 1) / max(most - 1, 1))] for place in range(most)]
