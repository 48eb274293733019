"""Chosen pixels against whole images."""

import pytest
import torch

from listed_gaussians import HEIGHT, SIZE, TILE, TILES, WIDTH, chosen_pixels, projected
from thermosplat import UserError, rasterize_to_pixels
from thermosplat.rasterizer.steps import build_sparse_tile_layout, isect_tiles_sparse, rasterize_to_pixels_sparse


def test_layout_of_chosen_pixels(device: torch.device) -> None:
    """Tiles, masks of bits, sums and order describe the pixels."""
    pixels, image_ids = chosen_pixels(device)
    layout = build_sparse_tile_layout(pixels, image_ids, 2, TILE, *TILES)
    assert torch.equal(layout.active_tile_mask.flatten().nonzero()[:, 0].int(), layout.active_tiles)
    assert layout.tile_pixel_cumsum[-1] == len(pixels)
    assert layout.tile_pixel_mask.dtype == torch.uint64
    assert layout.tile_pixel_mask.shape == (len(layout.active_tiles), 1)
    start = 0
    for tile, word, end in zip(
        layout.active_tiles.tolist(), layout.tile_pixel_mask[:, 0].tolist(), layout.tile_pixel_cumsum.tolist(),
        strict=True,
    ):  # fmt: skip
        of_tile = layout.pixel_map[start:end]
        rows, columns = pixels[of_tile].unbind(-1)
        assert ((image_ids[of_tile] * 9 + rows // TILE * 3 + columns // TILE) == tile).all()
        assert word == sum(1 << int(k) for k in rows % TILE * TILE + columns % TILE)
        start = end


def test_colours_of_chosen_pixels_are_those_of_whole_images(device: torch.device) -> None:
    """Colours, alphas and gradients. Only pairs of their tiles are listed."""
    p, (pixels, image_ids) = projected(device), chosen_pixels(device)
    backgrounds = torch.rand(2, 3, dtype=torch.float64, device=device)
    layout = build_sparse_tile_layout(pixels, image_ids, 2, TILE, *TILES)
    offsets, flatten_ids = isect_tiles_sparse(
        p["means2d"], p["radii"], p["depths"], layout.active_tile_mask, layout.active_tiles, 2, TILE, *TILES
    )
    assert offsets[-1] == len(flatten_ids) < len(p["flatten_ids"])
    of_tiles = (layout.active_tiles, offsets, flatten_ids, layout.tile_pixel_mask, layout.tile_pixel_cumsum)
    gaussians = [p["means2d"], p["conics"], p["colors"], p["opacities"].clone().requires_grad_()]
    colors, alphas = rasterize_to_pixels_sparse(*gaussians, image_ids, *of_tiles, layout.pixel_map, *SIZE, backgrounds)
    image, whole_alphas = rasterize_to_pixels(
        *gaussians, WIDTH, HEIGHT, TILE, p["offsets"], p["flatten_ids"], backgrounds
    )
    at = (image_ids, pixels[:, 0], pixels[:, 1])
    assert torch.equal(colors, image[at])
    assert torch.equal(alphas, whole_alphas[at])
    upstream = torch.randn(colors.shape, dtype=torch.float64).to(device)
    found = torch.autograd.grad((colors * upstream).sum(), gaussians, retain_graph=True)
    expected = torch.autograd.grad((image[at] * upstream).sum(), gaussians)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_no_pixel_is_chosen(device: torch.device) -> None:
    """Nothing comes back."""
    p = projected(device)
    none = torch.zeros(0, 2, dtype=torch.int64, device=device)
    layout = build_sparse_tile_layout(none, none[:, 0], 2, TILE, *TILES)
    assert layout.tile_pixel_cumsum.tolist() == [0]
    offsets, flatten_ids = isect_tiles_sparse(
        p["means2d"], p["radii"], p["depths"], layout.active_tile_mask, layout.active_tiles, 2, TILE, *TILES
    )
    gaussians = [p["means2d"], p["conics"], p["colors"], p["opacities"]]
    of_tiles = (layout.active_tiles, offsets, flatten_ids, layout.tile_pixel_mask, layout.tile_pixel_cumsum)
    colors, alphas = rasterize_to_pixels_sparse(*gaussians, none[:, 0], *of_tiles, layout.pixel_map, *SIZE)
    assert colors.shape == (0, 3)
    assert alphas.shape == (0, 1)


def test_mistakes_are_told() -> None:
    """One sentence that says what was expected."""
    twice = torch.tensor([[1, 2], [1, 2]])
    with pytest.raises(UserError, match="must not hold a pixel twice"):
        build_sparse_tile_layout(twice, torch.zeros(2), 1, TILE, *TILES)
    with pytest.raises(UserError, match="found one outside"):
        build_sparse_tile_layout(twice, torch.tensor([0, 1]), 1, TILE, *TILES)
    with pytest.raises(UserError, match=r"pixels must have shape \[P, 2\]"):
        build_sparse_tile_layout(twice[0], torch.zeros(2), 1, TILE, *TILES)
