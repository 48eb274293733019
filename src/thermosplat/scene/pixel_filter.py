"""How far a Gaussian's footprint is widened to the size of a pixel."""

from typing import NamedTuple


class PixelFilter(NamedTuple):
    """gsplat's argument of that name; 3DGS's filter by default."""

    eps2d: float = 0.3
    """Added to the variances of a footprint along both axes of the image [px²]. 3DGS."""
