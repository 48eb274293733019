"""No picture is larger than pictures may be; its proportions stay."""

import pytest

from thermosplat.viewer.picture_sizes import LARGEST_SIDE, MOST_PIXELS, fitting


@pytest.mark.parametrize("size", [(20_000, 20_000), (8192, 8192), (16_384, 1), (1, 16_384), (10**9, 3), (3841, 2160)])
def test_large_sizes_are_made_smaller(size: tuple[int, int]) -> None:
    """In sides and in pixels."""
    width, height = fitting(*size)
    assert max(width, height) <= LARGEST_SIDE
    assert 1 <= width * height <= MOST_PIXELS
    if min(width, height) > 100:
        assert width / height == pytest.approx(size[0] / size[1], rel=0.01)


def test_others_stay() -> None:
    """Also that of a window of 4K; nothing has no pixels."""
    assert fitting(3840, 2160) == (3840, 2160)
    assert fitting(640, 481) == (640, 481)
    assert fitting(0, -5) == (1, 1)
