"""Pieces of a path along which a drone looks one way."""

import numpy as np

from thermosplat.prepare.placing.straight_pieces import straight_pieces


def test_strips_to_and_fro_are_pieces() -> None:
    """The last of one strip and the first of the next are of different ones."""
    path = [(4.0 * i if k % 2 == 0 else 16.0 - 4.0 * i, 10.0 * k, 30.0) for k in range(3) for i in range(5)]
    assert straight_pieces(np.array(path)).tolist() == [0] * 5 + [1] * 5 + [2] * 5


def test_paths_without_pieces() -> None:
    """A zigzag, two images, and images of one place."""
    zigzag = np.array([(4.0 * i, 4.0 * (i % 2), 30.0) for i in range(6)])
    assert (straight_pieces(zigzag) == -1).all()
    assert (straight_pieces(zigzag[:2]) == -1).all()
    assert (straight_pieces(np.zeros((4, 3))) == -1).all()
