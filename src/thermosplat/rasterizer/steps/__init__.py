"""The steps of a rasterization as functions of their own, with gsplat's names, argument order and return values.

For code that imports them from gsplat. ``rasterization`` runs the same kernels without the conversions that these
interfaces need, and is quicker.
"""

from thermosplat.rasterizer.steps.contributors import (
    rasterize_contributing_gaussian_ids,
    rasterize_num_contributing_gaussians,
    rasterize_top_contributing_gaussian_ids,
)
from thermosplat.rasterizer.steps.covariances import quat_scale_to_covar_preci
from thermosplat.rasterizer.steps.harmonics import spherical_harmonics
from thermosplat.rasterizer.steps.pixels import rasterize_to_pixels
from thermosplat.rasterizer.steps.projected import fully_fused_projection
from thermosplat.rasterizer.steps.sparse_contributors import (
    rasterize_contributing_gaussian_ids_sparse,
    rasterize_num_contributing_gaussians_sparse,
    rasterize_top_contributing_gaussian_ids_sparse,
)
from thermosplat.rasterizer.steps.sparse_pixels import (
    SparseTileLayout,
    build_sparse_tile_layout,
    isect_tiles_sparse,
    rasterize_to_pixels_sparse,
)
from thermosplat.rasterizer.steps.tiles import isect_offset_encode, isect_tiles

__all__ = [
    "SparseTileLayout",
    "build_sparse_tile_layout",
    "fully_fused_projection",
    "isect_offset_encode",
    "isect_tiles",
    "isect_tiles_sparse",
    "quat_scale_to_covar_preci",
    "rasterize_contributing_gaussian_ids",
    "rasterize_contributing_gaussian_ids_sparse",
    "rasterize_num_contributing_gaussians",
    "rasterize_num_contributing_gaussians_sparse",
    "rasterize_to_pixels",
    "rasterize_to_pixels_sparse",
    "rasterize_top_contributing_gaussian_ids",
    "rasterize_top_contributing_gaussian_ids_sparse",
    "spherical_harmonics",
]
