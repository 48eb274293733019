"""Which photographs are matched: enough on all sides, and not many more."""

import numpy as np
import pytest

from flown_model import flight
from thermosplat.prepare.structure.pairs import chosen_pairs

NOTHING = np.full((300, 3), np.nan)


def alike_by(places: np.ndarray) -> np.ndarray:
    """Photographs look alike as far as they lie near each other."""
    return -np.linalg.norm(places[:, None] - places[None], axis=2).astype(np.float32)


def parts(count: int, pairs: list[tuple[int, int]]) -> int:
    """How many parts the pairs leave."""
    part = np.arange(count)
    for i, j in pairs:
        part[part == part[j]] = part[i]
    return len(set(part.tolist()))


def test_all_pairs_of_a_few() -> None:
    """Without positions as with them; likeness is not asked for."""
    assert len(chosen_pairs(NOTHING[:40], NotImplementedError)) == 780
    assert len(chosen_pairs(NOTHING[:120], NotImplementedError)) == 120 * 119 / 2
    assert len(chosen_pairs(np.zeros((40, 3)), NotImplementedError)) == 780


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("missing", [False, True])
def test_strips_are_linked_whatever_the_names(shuffled: bool, missing: bool) -> None:
    """Photographs every metre in strips 20 m apart: each meets the next strip, or the one after a missing one."""
    places = flight(strips=6, along=60).places * [1 / 6, 20 / 14, 1.0]
    if missing:
        places = np.delete(places, slice(120, 180), axis=0)
    if shuffled:
        places = np.random.default_rng(0).permutation(places)
    pairs = chosen_pairs(places, lambda: alike_by(places))
    assert len(pairs) < 15 * len(places)
    assert parts(len(places), pairs) == 1
    strips = np.unique(places[:, 1])
    number = np.searchsorted(strips, places[:, 1])
    across = [(i, j) for i, j in pairs if number[i] != number[j]]
    for strip in range(len(strips) - 1):
        linked = {i for pair in across for i in pair if {number[pair[0]], number[pair[1]]} == {strip, strip + 1}}
        assert set(np.flatnonzero(number == strip)) <= linked


def test_a_wrong_position_is_met_by_looks() -> None:
    """A third lies a kilometre off by GPS; each of them is matched with true neighbours that lie where they should."""
    places = flight(strips=6, along=10).places
    wrong = np.arange(0, 60, 3)
    moved = places.copy()
    moved[wrong] += [1000.0, 0.0, 0.0]
    pairs = chosen_pairs(moved, lambda: alike_by(places))
    assert parts(60, pairs) == 1
    near = alike_by(places) > -9.0
    for i in wrong:
        assert any(near[i, j] and j not in wrong for pair in pairs if i in pair for j in pair if j != i)


def test_a_photograph_without_a_position_is_met_by_looks_and_names() -> None:
    """One in the middle of a flight."""
    places = flight(strips=6, along=10).places
    known = places.copy()
    known[25] = np.nan
    partners = {j for pair in chosen_pairs(known, lambda: alike_by(places)) if 25 in pair for j in pair} - {25}
    assert {24, 26, 17, 33} <= partners
    assert len(partners) < 45


def test_pairs_of_many_without_positions_are_bounded() -> None:
    """2,000 photographs of a walk that returns: each is matched with at most 28 of its own choice, its return too."""
    angle = np.linspace(0, 4 * np.pi, 2000, endpoint=False)
    walk = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    pairs = chosen_pairs(np.full((2000, 3), np.nan), lambda: alike_by(walk))
    assert len(pairs) < 2000 * 28
    assert {(0, 1), (0, 8), (0, 1000), (1998, 1999)} <= set(pairs)
    assert len(set(pairs)) == len(pairs)
    assert all(i < j for i, j in pairs)
