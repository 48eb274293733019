"""Pictures of several spectra: wipes, insets, titles and colour bars."""

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.pictures.layouts import arranged, wiped, with_legend
from thermosplat.thermal.radiometry import FLIR_IRON, PixelScale

RED, BLUE = (200, 0, 0), (0, 0, 200)


def plain(color: tuple[int, int, int], width: int = 120, height: int = 90) -> np.ndarray:
    return np.full((height, width, 3), color, np.uint8)


def share_of(picture: np.ndarray, color: tuple[int, int, int]) -> float:
    return float((picture == color).all(axis=-1).mean())


def test_a_wipe_goes_over_the_picture_and_back() -> None:
    """It begins with the first spectrum, shows the second in the middle of the path, and ends with the first."""
    shares = [share_of(arranged([plain(RED), plain(BLUE)], "wipe", moment), RED) for moment in (0, 0.25, 0.5, 0.75, 1)]
    assert shares[0] == shares[-1] == 1.0
    assert shares[2] == 0.0
    assert shares[1] == pytest.approx(0.5, abs=0.03) == shares[3]


def test_the_edge_of_a_wipe_is_where_it_is_said_to_be() -> None:
    """Left of it is the first image, right of it the second, between them a white line."""
    picture = wiped(plain(RED), plain(BLUE), 0.25)
    assert (picture[:, :28] == RED).all()
    assert (picture[:, 32:] == BLUE).all()
    assert (picture[:, 30] == 255).all()


def test_a_wipe_of_three_shows_each_in_turn() -> None:
    """Two passages of the edge: to the second spectrum and back, then from the second to the third."""
    images = [plain(RED), plain(BLUE), plain((0, 200, 0))]
    assert share_of(arranged(images, "wipe", 0.0), RED) == 1.0
    assert share_of(arranged(images, "wipe", 0.25), BLUE) == 1.0
    assert share_of(arranged(images, "wipe", 0.75), (0, 200, 0)) == 1.0


def test_an_inset_lies_in_the_corner() -> None:
    """The second spectrum, a third as wide and of its own shape, inside a white frame; the size stays."""
    picture = arranged([plain(RED), plain(BLUE, 60, 60)], "inset", 0.5)
    assert picture.shape == (90, 120, 3)
    rows, columns = np.nonzero((picture == BLUE).all(axis=-1))
    assert (np.ptp(columns) + 1, np.ptp(rows) + 1) == (40, 40)
    assert columns.min() > 60
    assert rows.min() > 40
    assert (picture[rows.min() - 1, columns.min()] == 255).all()


def test_one_spectrum_is_itself_in_every_layout() -> None:
    """There is nothing to wipe to."""
    for layout in ("side-by-side", "wipe", "inset"):
        np.testing.assert_array_equal(arranged([plain(RED)], layout, 0.3), plain(RED))


def test_legends_have_room_of_their_own() -> None:
    """The bar of a measured spectrum stands at the right, the title above; the picture itself is untouched."""
    scales = [PixelScale("scalar", FLIR_IRON, (10.0, 30.0), "celsius"), PixelScale("scalar", FLIR_IRON)]
    picture = with_legend(plain(RED), scales, ["°C", ""], "Roof, 21 °C")
    above = picture.shape[0] - 90
    assert above > 10
    np.testing.assert_array_equal(picture[above:, :120], plain(RED))
    assert picture.shape[1] > 150
    assert picture[:above].max() == 255  # the title
    assert with_legend(plain(RED), scales, ["°C", ""]).shape[0] == 90


def test_titles_that_cannot_be_written_are_refused() -> None:
    """Fonts of pictures have ASCII and a degree sign."""
    with pytest.raises(UserError, match="letters that pictures cannot show: ä"):
        with_legend(plain(RED), [], [], "Wärme")
