"""How rows are divided over ranks."""

import pytest
import torch

from thermosplat.distributed.team import Team, blocks


@pytest.mark.parametrize(("rows", "ranks"), [(10, 4), (8, 4), (3, 4), (0, 2), (7, 1)])
def test_blocks_are_equal_to_one_row_and_follow_each_other(rows: int, ranks: int) -> None:
    """All rows are dealt, the first ranks have the one more, and slices of ranks join without gaps."""
    counts = blocks(rows, ranks)
    assert sum(counts) == rows
    assert max(counts) - min(counts) <= 1
    assert counts == sorted(counts, reverse=True)
    slices = [Team(rank, ranks, torch.device("cpu")).block_of(rows) for rank in range(ranks)]
    assert [index for part in slices for index in range(part.start, part.stop)] == list(range(rows))
