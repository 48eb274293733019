"""How many pixels a moving picture may have, so that it moves smoothly on this machine."""

import math

TARGET_SECONDS = 0.12
"""For one picture while the camera moves: eight a second, above the five at which motion is still followed."""
FIRST_PIXELS, LEAST_PIXELS = 320 * 180, 96 * 54
_STEEPEST = 4.0
"""Factor by which the number of pixels changes from one picture to the next at most."""


class Pace:
    """Learns from every picture how large the next one may be.

    Args:
        target: Seconds per picture.
    """

    def __init__(self, target: float = TARGET_SECONDS) -> None:
        self.target = target
        self.pixels: float = FIRST_PIXELS
        self._seconds_per_pixel = 0.0

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Size [px] of the next moving picture, in the proportions of the full one and at most as large."""
        factor = min(1.0, math.sqrt(self.pixels / (width * height)))
        return max(1, round(width * factor)), max(1, round(height * factor))

    def took(self, width: int, height: int, seconds: float) -> None:
        """Note what a picture cost.

        Args:
            width: Its width [px].
            height: Its height [px].
        """
        self._seconds_per_pixel = seconds / (width * height)
        factor = min(max(self.target / max(seconds, 1e-6), 1 / _STEEPEST), _STEEPEST)
        possible = max(width * height * factor, LEAST_PIXELS)
        self.pixels = 0.5 * self.pixels + 0.5 * possible

    def seconds(self, width: int, height: int) -> float:
        """How long a picture of that size [px] takes at most, by the last one; 0 before the first."""
        return self._seconds_per_pixel * width * height
