"""How large pictures may be, whoever asks for them."""

import math

LARGEST_SIDE = 8192
"""[px]."""
MOST_PIXELS = 3840 * 2160
"""Of one picture. On a CPU such a one takes 1.3 GB while it is made, and ten to twenty seconds of two cores."""
MOST_IMAGES = 10_000
"""Of a video."""


def fitting(width: int, height: int) -> tuple[int, int]:
    """A size [px] of the same proportions that is no larger than pictures may be.

    Args:
        width: What is asked for [px]; less than 1 is 1.
        height: What is asked for [px].
    """
    width, height = max(1, width), max(1, height)
    factor = min(1.0, LARGEST_SIDE / max(width, height), math.sqrt(MOST_PIXELS / (width * height)))
    return max(1, int(factor * width)), max(1, int(factor * height))
