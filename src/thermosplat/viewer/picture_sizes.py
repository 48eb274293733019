"""How large pictures may be, whoever asks for them."""

import math

LARGEST_SIDE = 8192
"""[px]."""
MOST_PIXELS = 1 << 24
"""16.8 megapixels, as 4096 x 4096: a picture with its values takes about half a gigabyte while it is made."""
MOST_WINDOW_PIXELS = 1 << 23
"""Of a picture on the page, as 3840 x 2160: each tab keeps its last one."""
MOST_IMAGES = 10_000
"""Of a video."""


def fitting(width: int, height: int, most_pixels: int = MOST_PIXELS) -> tuple[int, int]:
    """A size [px] of the same proportions that is no larger than pictures may be.

    Args:
        width: What is asked for [px]; less than 1 is 1.
        height: What is asked for [px].
        most_pixels: How many it may have.
    """
    width, height = max(1, width), max(1, height)
    factor = min(1.0, LARGEST_SIDE / max(width, height), math.sqrt(most_pixels / (width * height)))
    return max(1, int(factor * width)), max(1, int(factor * height))
