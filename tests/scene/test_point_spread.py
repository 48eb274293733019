"""Point spreads of spectra: who has one, how wide it is, and that it is learnt."""

import dataclasses

import pytest
import torch

from thermosplat.fused.point_spread import blurred_by_gaussian
from thermosplat.scene.point_spread import PointSpreads
from thermosplat.spectra import Spectrum

RGB = Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal")
THERMAL = Spectrum("thermal", 3, "color", "offset", (3, 4), None, point_spread=0.05)


def test_those_that_ask_for_one() -> None:
    """Images of others are passed on as they are, and without any nothing is stored."""
    spreads, image = PointSpreads([RGB, THERMAL]), torch.rand(6, 20, 3)
    assert spreads("rgb", image) is image
    assert not torch.allclose(spreads("thermal", image), image)
    assert spreads.widths() == pytest.approx({"thermal": 0.05})
    assert not PointSpreads([RGB]).state_dict()


@pytest.mark.parametrize("width", [10, 40])
def test_widths_are_shares_of_the_image(width: int) -> None:
    """So images of half the size have half the blur [px]."""
    image = torch.rand(8, width, 2)
    expected = blurred_by_gaussian(image, torch.tensor(0.05 * width), radius=round(0.2 * width))
    torch.testing.assert_close(PointSpreads([THERMAL])("thermal", image), expected)


def test_the_width_is_learnt() -> None:
    """From a start that is too narrow, and from one that is too wide, to what blurred the image."""
    sharp = torch.rand(30, 40, 2)
    blurred = blurred_by_gaussian(sharp, torch.tensor(1.6), radius=12)
    for start in (0.03, 0.08):
        spreads = PointSpreads([dataclasses.replace(THERMAL, point_spread=start)])
        optimizer = torch.optim.Adam(spreads.parameters(), lr=0.05)
        for _ in range(150):
            optimizer.zero_grad()
            (spreads("thermal", sharp) - blurred).square().mean().backward()
            optimizer.step()
        assert spreads.widths()["thermal"] == pytest.approx(0.04, rel=0.02)
