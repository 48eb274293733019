"""How far a Gaussian's footprint is widened to the size of a pixel."""

from typing import Literal, NamedTuple


class PixelFilter(NamedTuple):
    """gsplat's arguments: fields have their names, and stand for 3DGS's filter by default."""

    rasterize_mode: Literal["classic", "antialiased"] = "classic"
    """Antialiased: what is widened becomes fainter, so that its sum over the image stays. Mip-Splatting."""
    eps2d: float = 0.3
    """Added to the variances of a footprint along both axes of the image [px²]. 3DGS."""
