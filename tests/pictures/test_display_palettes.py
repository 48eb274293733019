"""The palettes that pictures can be shown in."""

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.pictures.display_palettes import DISPLAY_PALETTES, display_palette


def test_palettes_have_their_ends() -> None:
    """White hot is black where it is cold; black hot the other way; FLIR Iron goes through its nine stops."""
    ends = {name: np.rint(255 * display_palette(name).to_color(np.array([0.0, 1.0]))) for name in DISPLAY_PALETTES}
    assert ends["white hot"].tolist() == [[0, 0, 0], [255, 255, 255]]
    assert ends["black hot"].tolist() == [[255, 255, 255], [0, 0, 0]]
    assert ends["viridis"].tolist() == [[68, 1, 84], [253, 231, 37]]
    np.testing.assert_allclose(255 * display_palette("iron").to_color(64 / 255), (144, 2, 164), atol=0.5)
    with pytest.raises(UserError, match="no palette"):
        display_palette("pink")
