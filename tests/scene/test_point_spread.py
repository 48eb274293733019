"""Point spreads of cameras: how wide they are, and that they are learnt."""

import pytest
import torch

from thermosplat.fused.point_spread import blurred_by_gaussian
from thermosplat.scene.point_spread import PointSpread


@pytest.mark.parametrize("width", [10, 40])
def test_widths_are_shares_of_the_image(width: int) -> None:
    """So images of half the size have half the blur [px]."""
    image = torch.rand(8, width, 2)
    expected = blurred_by_gaussian(image, torch.tensor(0.05 * width), radius=round(0.2 * width))
    torch.testing.assert_close(PointSpread(0.05)(image), expected)


def test_the_width_is_learnt() -> None:
    """From a start that is too narrow, and from one that is too wide, to what blurred the image."""
    sharp = torch.rand(30, 40, 2)
    blurred = blurred_by_gaussian(sharp, torch.tensor(1.6), radius=12)
    for start in (0.03, 0.08):
        spread = PointSpread(start)
        optimizer = torch.optim.Adam(spread.parameters(), lr=0.05)
        for _ in range(150):
            optimizer.zero_grad()
            (spread(sharp) - blurred).square().mean().backward()
            optimizer.step()
        assert spread.width == pytest.approx(0.04, rel=0.02)
