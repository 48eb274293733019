"""Three components and an index describe a rotation."""

import numpy as np

from thermosplat.export.formats.packed_quaternions import smallest_three


def test_the_rotation_comes_back_from_the_three_smallest_components() -> None:
    """The largest component follows from the length; the quaternion is the given one or its negative."""
    quats = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    largest, others = smallest_three(quats)
    assert np.abs(others).max() <= np.sqrt(0.5) + 1e-6
    for quat, index, three in zip(quats, largest, others, strict=True):
        whole = np.insert(three, index, np.sqrt(1 - np.square(three).sum()))
        assert abs(abs(whole @ quat) - 1) < 1e-5
        assert index == np.abs(quat).argmax()


def test_a_negative_largest_component_turns_all_signs() -> None:
    """q and -q are one rotation, and are stored alike."""
    quats = np.array([[0.1, -0.9, 0.3, -0.3], [-0.1, 0.9, -0.3, 0.3]], np.float32)
    largest, others = smallest_three(quats)
    assert largest.tolist() == [1, 1]
    np.testing.assert_array_equal(others[0], others[1])
    np.testing.assert_allclose(others[0], [-0.1, -0.3, 0.3])
