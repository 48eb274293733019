"""Which of many are chosen."""

from thermosplat.evenly_chosen import evenly_chosen


def test_both_ends_are_among_them() -> None:
    """All where they are few; of one the first."""
    assert evenly_chosen("0123456789", 3) == ["0", "4", "9"]
    assert evenly_chosen(range(100), 12) == [0, 9, 18, 27, 36, 45, 54, 63, 72, 81, 90, 99]
    assert evenly_chosen(range(2), 3) == [0, 1]
    assert evenly_chosen(range(9), 1) == [0]
    assert evenly_chosen([], 3) == []
