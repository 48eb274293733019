"""The similarity between two scenes, by matched points of which some are wrong."""

import numpy as np
import pytest

from thermosplat.comparison.shared_frame import agreeing, matched, together
from thermosplat.export.maps.map_frame import MapFrame

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def matched_points(wrong: float, scale: float = 1.7) -> tuple[np.ndarray, np.ndarray]:
    """Points on a ground with houses 30 away, and where they are in the first scene, to a thousandth of that."""
    generator = np.random.default_rng(0)
    source = generator.uniform([-20, -20, 0], [20, 20, 6], (400, 3))
    target = MapFrame(TURN, scale, np.array([3.0, -2.0, 1.0])).to_map(source)
    target += generator.normal(0, 0.03, target.shape)
    strangers = generator.random(len(source)) < wrong
    target[strangers] = generator.uniform(-40, 40, (int(strangers.sum()), 3))
    return source, target


@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_the_similarity_of_most_points(wrong: float) -> None:
    """Its scale, turn and place are exact to a fraction of the points' error, whatever the others say."""
    source, target = matched_points(wrong)
    found = together(source, target, np.full(len(source), 30.0))
    places = np.random.default_rng(1).uniform(-20, 20, (50, 3))
    truth = MapFrame(TURN, 1.7, np.array([3.0, -2.0, 1.0])).to_map(places)
    assert np.abs(found.to_first.to_map(places) - truth).max() < 0.02
    assert found.residual == pytest.approx(0.046, abs=0.02)
    assert found.matches >= 0.8 * (1 - wrong) * len(source)


def test_points_that_have_nothing_in_common() -> None:
    """No similarity brings a tenth of them together."""
    source, target = matched_points(1.0)
    assert agreeing(source, target, 0.3).mean() < 0.1


def test_descriptors_match_both_ways_and_clearly() -> None:
    """One that has two likenesses of the same strength has none."""
    ours = np.linalg.qr(np.random.default_rng(0).normal(size=(128, 20)))[0].T.astype(np.float32)
    theirs = ours[[3, 7, 7, 11]]
    near, far = matched(ours[[7, 3, 11]], theirs)
    assert set(zip(near.tolist(), far.tolist())) == {(1, 0), (0, 1), (2, 3)}
    twice = matched(np.concatenate([ours[:5], ours[:1]]), ours[:1])
    assert not len(twice[0])
    assert not len(matched(ours[:1], ours)[0])


def test_a_map_of_a_scene_inside_another() -> None:
    """Going to the first scene and from there to the map is what the composed frame does at once."""
    inner, outer = MapFrame(TURN, 2.0, np.array([1.0, 2.0, 3.0])), MapFrame(TURN.T, 0.5, np.array([9.0, 8.0, 7.0]))
    points = np.random.default_rng(2).normal(size=(10, 3))
    assert np.allclose(outer.of(inner).to_map(points), outer.to_map(inner.to_map(points)))
    assert np.allclose(inner.inverse.to_map(inner.to_map(points)), points)
    assert np.allclose(outer.of(MapFrame(TURN)).to_map(points), outer.to_map(MapFrame(TURN).to_map(points)))
