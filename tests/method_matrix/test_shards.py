"""Parts of a matrix are disjoint and together all of it."""

import pytest

from thermosplat.errors import UserError
from thermosplat.method_matrix.shards import Shard, parse_shard


@pytest.mark.parametrize(("count", "parts"), [(0, 3), (2, 5), (24, 8), (25, 8), (7, 1)])
def test_every_item_is_in_one_part(count: int, parts: int) -> None:
    """Parts differ by at most one item."""
    items = list(range(count))
    shares = [Shard(number, parts).of(items) for number in range(1, parts + 1)]
    assert sorted(item for share in shares for item in share) == items
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_no_part_gets_one_method_of_every_scene() -> None:
    """As many methods as parts, cells listed scene by scene."""
    cells = [(scene, method) for scene in range(6) for method in range(4)]
    for number in range(1, 5):
        assert {method for _, method in Shard(number, 4).of(cells)} == {0, 1, 2, 3}


def test_a_part_is_written_with_the_number_of_parts() -> None:
    """Counted from 1; anything else is refused with an example."""
    assert parse_shard("2/8") == Shard(2, 8)
    assert parse_shard(None).of([1, 2]) == [1, 2]
    for wrong in ("0/8", "9/8", "2", "2/0", "-1/8", "a/b", "2/8/1", ""):
        with pytest.raises(UserError, match="--shard must be") as caught:
            parse_shard(wrong)
        assert "2/8" in str(caught.value.hint)
