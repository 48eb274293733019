"""How the spectra of one moment are put into one picture: beside each other, behind a wipe, or one inside the other."""

import math
from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from thermosplat.errors import UserError
from thermosplat.pictures.color_bar import color_bar, write_text
from thermosplat.pictures.image_display import Image8, fitted, resized, side_by_side
from thermosplat.thermal.radiometry import PixelScale

Layout = Literal["side-by-side", "wipe", "inset"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)

_EDGE = (255, 255, 255)
_INSET_SHARE, _INSET_GAP = 1 / 3, 0.02
"""Width of a picture in the picture, and its distance from the border, of the whole width."""


def arranged(images: Sequence[Image8], layout: Layout, moment: float) -> Image8:
    """One picture of several.

    Args:
        images: At least one, 8-bit RGB, [H', W', 3] each; the first one's size is that of wipes and insets.
        layout: How. A wipe shows the first image left of an edge that wanders, and the next right of it; with more
            than two, they take turns. An inset shows the others small in the first one's lower right corner, from the
            right to the left.
        moment: Where in the sequence the picture is, 0 to 1: a wipe's edge goes to the right and back once per pair.

    Returns:
        8-bit RGB.
    """
    if layout == "side-by-side" or len(images) == 1:
        return side_by_side(images)
    height, width = images[0].shape[:2]
    if layout == "wipe":
        turns = len(images) - 1
        turn = min(int(moment * turns), turns - 1)
        share = 0.5 - 0.5 * math.cos(2 * math.pi * (moment * turns - turn))
        return wiped(images[turn], fitted(images[turn + 1], width, height), 1.0 - share)
    picture = images[0].copy()
    gap = max(2, round(_INSET_GAP * width))
    right = width - gap
    for image in images[1:]:
        across = max(8, round(_INSET_SHARE * width / max(1, (len(images) - 1) / 2)))
        down = max(8, round(across * image.shape[0] / image.shape[1]))
        if down > height - 2 * gap or across > right - gap:
            break  # no room is left
        top, left = height - gap - down, right - across
        picture[top - 1 : top + down + 1, left - 1 : left + across + 1] = _EDGE
        picture[top : top + down, left : left + across] = resized(image, across, down)
        right = left - gap
    return picture


def wiped(left: Image8, right: Image8, share: float) -> Image8:
    """Two images of one size on both sides of a vertical edge.

    Args:
        left: Shown left of the edge, [H, W, 3].
        right: Shown right of it, [H, W, 3].
        share: Where the edge is, 0 (all is ``right``) to 1 (all is ``left``).
    """
    edge = round(share * left.shape[1])
    picture = np.concatenate([left[:, :edge], right[:, edge:]], axis=1)
    if 0 < edge < left.shape[1]:
        thick = max(1, left.shape[1] // 400)
        picture[:, max(0, edge - thick) : edge + thick] = _EDGE
    return picture


def with_legend(picture: Image8, scales: Sequence[PixelScale], units: Sequence[str], title: str = "") -> Image8:
    """A picture with a title above and a colour bar of each measured spectrum to its right.

    Args:
        picture: 8-bit RGB, [H, W, 3].
        scales: What the palettes mean, at most one per bar; those without a range get none.
        units: Name of each one's unit, such as "°C".
        title: One line of ASCII and "°"; "" for none.

    Raises:
        UserError: The title has letters that the fonts of pictures lack.
    """
    check_title(title)
    height = picture.shape[0]
    bars = [
        color_bar(scale.palette, *scale.range, unit, max(60, height))[:height]
        for scale, unit in zip(scales, units, strict=True)
        if scale.range is not None
    ]
    picture = np.concatenate([picture, *(fitted(bar, bar.shape[1], height) for bar in bars)], axis=1)
    if not title:
        return picture
    size = max(0.4, picture.shape[1] / 1400)
    band = np.zeros((round(44 * size) + 4, picture.shape[1], 3), np.uint8)
    write_text(band, title, round(12 * size), round(30 * size), size, max(1, round(size * 1.5)))
    return np.concatenate([band, picture])


def check_title(title: str) -> None:
    """Refuse a title that cannot be written.

    Raises:
        UserError: It has letters other than ASCII's and "°".
    """
    wrong = sorted({letter for letter in title if letter != "°" and not (letter.isascii() and letter.isprintable())})
    if wrong:
        raise UserError(
            f"--title {title!r} has letters that pictures cannot show: {' '.join(wrong)}.",
            "Write it in the letters of English; ° is fine.",
        )
