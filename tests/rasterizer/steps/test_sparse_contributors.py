"""Contributors of chosen pixels against those of whole images."""

import pytest
import torch

from listed_gaussians import SIZE, TILE, TILES, chosen_pixels, listed, projected
from thermosplat import UserError
from thermosplat.rasterizer.steps import (
    build_sparse_tile_layout,
    isect_tiles_sparse,
    rasterize_contributing_gaussian_ids,
    rasterize_contributing_gaussian_ids_sparse,
    rasterize_num_contributing_gaussians,
    rasterize_num_contributing_gaussians_sparse,
    rasterize_top_contributing_gaussian_ids,
    rasterize_top_contributing_gaussian_ids_sparse,
)


def test_contributors_of_chosen_pixels_are_those_of_whole_images(device: torch.device) -> None:
    """Counts; all Gaussians with their weights; and the two of the largest weights."""
    p, (pixels, image_ids) = projected(device), chosen_pixels(device)
    layout = build_sparse_tile_layout(pixels, image_ids, 2, TILE, *TILES)
    offsets, flatten_ids = isect_tiles_sparse(
        p["means2d"], p["radii"], p["depths"], layout.active_tile_mask, layout.active_tiles, 2, TILE, *TILES
    )
    of_tiles = (layout.active_tiles, offsets, flatten_ids, layout.tile_pixel_mask, layout.tile_pixel_cumsum)
    at = (image_ids, pixels[:, 0], pixels[:, 1])

    shown = (p["means2d"], p["conics"], p["opacities"])
    counts, _ = rasterize_num_contributing_gaussians_sparse(*shown, *of_tiles, layout.pixel_map, *SIZE)
    whole_counts, _ = rasterize_num_contributing_gaussians(*listed(p))
    assert torch.equal(counts, whole_counts[at])
    ids, weights = rasterize_contributing_gaussian_ids_sparse(*shown, *of_tiles, layout.pixel_map, counts, *SIZE)
    whole = rasterize_contributing_gaussian_ids(*listed(p), whole_counts)
    assert torch.equal(ids, whole[0][at][:, : ids.shape[1]])
    assert torch.equal(weights, whole[1][at][:, : ids.shape[1]])
    top, _ = rasterize_top_contributing_gaussian_ids_sparse(*shown, *of_tiles, layout.pixel_map, *SIZE, 2)
    assert torch.equal(top, rasterize_top_contributing_gaussian_ids(*listed(p), 2)[0][at])
    with pytest.raises(UserError, match="num_depth_samples must be at least 1"):
        rasterize_top_contributing_gaussian_ids_sparse(*shown, *of_tiles, layout.pixel_map, *SIZE, 0)
