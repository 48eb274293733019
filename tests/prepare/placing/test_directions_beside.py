"""Images that look another way than those taken beside them."""

import cv2
import numpy as np
import pytest

from thermosplat.prepare.placing.directions_beside import turned_from_beside


def test_the_smallest_turn_against_what_lies_beside_counts() -> None:
    """A drone that turns round between two strips looks like one side; a single image that is turned like none."""
    degrees = [0.0, 1.0, 2.0, 181.0, 180.0, 190.0, 180.5, 181.5]
    rotations = {
        number: cv2.Rodrigues(np.array([0.0, 0.0, np.radians(turn)]))[0] for number, turn in enumerate(degrees)
    }
    found = turned_from_beside(rotations)
    assert list(found.values()) == pytest.approx([1.0, 1.0, 1.0, 0.5, 0.5, 8.5, 0.5, 1.0], abs=1e-3)
    assert turned_from_beside({4: np.eye(3)}) == {4: 0.0}
