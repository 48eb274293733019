"""The steps of a rasterization as functions of their own, with gsplat's names, argument order and return values.

For code that imports them from gsplat. ``rasterization`` runs the same kernels without the conversions that these
interfaces need, and is quicker.
"""

from thermosplat.rasterizer.steps.covariances import quat_scale_to_covar_preci
from thermosplat.rasterizer.steps.fully_fused_projection import fully_fused_projection
from thermosplat.rasterizer.steps.harmonics import spherical_harmonics
from thermosplat.rasterizer.steps.pixels import rasterize_to_pixels
from thermosplat.rasterizer.steps.tiles import isect_offset_encode, isect_tiles

__all__ = [
    "fully_fused_projection",
    "isect_offset_encode",
    "isect_tiles",
    "quat_scale_to_covar_preci",
    "rasterize_to_pixels",
    "spherical_harmonics",
]
