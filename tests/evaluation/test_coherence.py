"""Coherence of spectra: the same edges agree, others do not."""

import numpy as np
import pytest
import torch

from thermosplat.evaluation.coherence import coherence, edge_agreement, edges
from viewed_toy import viewed_toy


def square(left: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    image = np.full((60, 60), low)
    image[20:40, left : left + 20] = high
    return image


@pytest.mark.parametrize(("left", "agreement"), [(15, 1.0), (16, 1.0), (30, 0.25)])
def test_edges_agree_where_things_lie_at_the_same_places(left: int, agreement: float) -> None:
    """Two pixels are near enough, the unit and the sign do not count, and what lies elsewhere does."""
    found = edge_agreement(edges(square(15)), edges(square(left, 310.0, 280.0)))
    assert found == pytest.approx(agreement, abs=0.15)


def test_images_without_edges() -> None:
    """Two of them have nothing to compare; one of them agrees with nothing."""
    flat = edges(np.full((60, 60), 7.0))
    assert np.isnan(edge_agreement(flat, flat))
    assert edge_agreement(flat, edges(square(15))) == 0.0
    assert not edges(np.full((60, 60), np.nan)).any()


def test_spectra_of_one_geometry_are_coherent() -> None:
    """Depths of a scene whose spectra share their opacities are the same."""
    scene = viewed_toy()
    assert scene.capture is not None
    with torch.no_grad():
        found = coherence(scene.model, scene.capture, sh_degree=1)
    assert set(found) == {"rgb-thermal"}
    assert 0 <= found["rgb-thermal"]["depth_difference"] < 0.2
