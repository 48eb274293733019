"""Numbers of any library's kind, and checks that are done once."""

import numpy as np
import pytest
import torch

from thermosplat import UserError
from thermosplat.rasterizer.arguments import remembered
from thermosplat.rasterizer.checked_numbers import as_whole


def test_whole_numbers_of_any_kind() -> None:
    """Become Python's own; what is none stays what it is, to be refused."""
    for number in (3, np.int64(3), torch.tensor(3)):
        assert type(as_whole(number)) is int
        assert as_whole(number) == 3
    for other in (None, True, 3.0, "3", torch.tensor(True)):
        assert as_whole(other) is other


def test_a_check_is_done_once_for_the_same_numbers() -> None:
    """And anew for numbers that are equal and of another kind, as a check may tell them apart."""
    seen: list[object] = []

    @remembered
    def check(size: object, mode: object) -> tuple[object, object]:
        seen.append(size)
        if size is True:
            raise UserError("True is no size.")
        return size, mode

    for size in (1, 1, 1.0, 1.0, 2, 1):
        found, mode = check(size, "classic")
        assert (type(found), found, mode) == (type(size), size, "classic")
    assert seen == [1, 1.0, 2]
    for _ in range(2):
        with pytest.raises(UserError):
            check(True, "classic")
    assert seen == [1, 1.0, 2, True, True]


def test_what_may_change_is_never_remembered() -> None:
    """A tensor is the same object after it was changed in place; a list cannot be a key."""
    seen = []

    @remembered
    def check(plane: object) -> object:
        seen.append(plane)
        return float(plane[0]) if isinstance(plane, list) else float(plane)  # type: ignore[arg-type]

    plane = torch.tensor(1.0)
    assert check(plane) == 1.0
    plane += 1.0
    assert check(plane) == 2.0
    assert check(np.float32(0.5)) == check([0.5]) == check(plane=0.5) == 0.5
    assert len(seen) == 5
