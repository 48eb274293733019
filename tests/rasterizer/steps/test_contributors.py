"""Contributors of pixels against dense torch, and chosen pixels against whole images."""

from typing import Any

import pytest
import torch
from torch import Tensor

from gaussian_scenes import leaves, random_scene
from thermosplat import UserError, fully_fused_projection, isect_offset_encode, isect_tiles, rasterize_to_pixels
from thermosplat.rasterizer.steps import (
    build_sparse_tile_layout,
    isect_tiles_sparse,
    rasterize_contributing_gaussian_ids,
    rasterize_contributing_gaussian_ids_sparse,
    rasterize_num_contributing_gaussians,
    rasterize_num_contributing_gaussians_sparse,
    rasterize_to_pixels_sparse,
    rasterize_top_contributing_gaussian_ids,
    rasterize_top_contributing_gaussian_ids_sparse,
)

WIDTH, HEIGHT, TILE = 23, 18, 8
TILES = (3, 3)


def projected(device: torch.device, seed: int = 0) -> dict[str, Any]:
    """Two images of Gaussians, some so opaque that pixels end early, and their lists."""
    scene = leaves(random_scene(n=40, cameras=2, width=WIDTH, height=HEIGHT, seed=seed), device, torch.float64)
    opacities = (0.4 + 0.6 * scene["opacities"].detach()).clamp(max=1.0)
    geometry = [scene[name] for name in ("quats", "scales", "viewmats", "Ks")]
    radii, means2d, depths, conics, _ = fully_fused_projection(scene["means"], None, *geometry, WIDTH, HEIGHT)
    _, isect_ids, flatten_ids = isect_tiles(means2d, radii, depths, TILE, *TILES)
    return {
        "means2d": means2d,
        "radii": radii,
        "depths": depths,
        "conics": conics,
        "opacities": opacities.expand(2, -1),
        "colors": scene["colors"].expand(2, -1, -1),
        "offsets": isect_offset_encode(isect_ids, 2, *TILES),
        "flatten_ids": flatten_ids,
    }


def true_weights(p: dict[str, Any]) -> list[tuple[Tensor, Tensor]]:
    """Flat indices and weights of what each pixel shows, front to back, of all pixels of both images."""
    ends = [*p["offsets"].flatten().tolist(), len(p["flatten_ids"])]
    means2d, conics, opacities = (p[name].detach().flatten(0, 1).cpu() for name in ("means2d", "conics", "opacities"))
    found = []
    for image in range(2):
        for y in range(HEIGHT):
            for x in range(WIDTH):
                tile = (image * TILES[1] + y // TILE) * TILES[0] + x // TILE
                ids = p["flatten_ids"][ends[tile] : ends[tile + 1]].long().cpu()
                dx, dy = (means2d[ids] - torch.tensor([x + 0.5, y + 0.5])).unbind(-1)
                a, b, c = conics[ids].unbind(-1)
                alphas = (opacities[ids] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp(max=0.999)
                drawn = alphas >= 1 / 255
                after = torch.cumprod(torch.where(drawn, 1 - alphas, 1.0), 0)
                drawn &= after > 1e-4
                before = torch.cat([torch.ones(1, dtype=torch.float64), after])[:-1]
                found.append((ids[drawn], (alphas * before)[drawn]))
    return found


def lists(p: dict[str, Any]) -> list[Any]:
    """What the functions of contributors take first."""
    return [p["means2d"], p["conics"], p["opacities"], p["offsets"], p["flatten_ids"], WIDTH, HEIGHT, TILE]


def test_counts_and_lists_are_those_of_the_blending(device: torch.device) -> None:
    """Every pixel's Gaussians, in order, with their weights; alphas are the image's."""
    p = projected(device)
    counts, alphas = rasterize_num_contributing_gaussians(*lists(p))
    ids, weights = rasterize_contributing_gaussian_ids(*lists(p), counts)
    assert counts.shape == alphas.shape == (2, HEIGHT, WIDTH)
    assert ids.shape == weights.shape == (2, HEIGHT, WIDTH, int(counts.max()))
    for (true_ids, true), count, one, weight in zip(
        true_weights(p), counts.flatten().cpu(), ids.flatten(0, 2).cpu(), weights.flatten(0, 2).cpu(), strict=True
    ):
        assert count == len(true_ids)
        assert torch.equal(one[:count].long(), true_ids)
        assert (one[count:] == -1).all()
        assert not weight[count:].any()
        torch.testing.assert_close(weight[:count], true, rtol=1e-10, atol=1e-12)
    _, image_alphas = rasterize_to_pixels(
        p["means2d"], p["conics"], p["colors"], p["opacities"], WIDTH, HEIGHT, TILE, p["offsets"], p["flatten_ids"]
    )
    torch.testing.assert_close(alphas, image_alphas[..., 0].detach(), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("samples", [1, 3, 50])
def test_top_contributors_are_the_largest_weights_in_order(device: torch.device, samples: int) -> None:
    """The K largest, front to back; -1 and 0 where there are fewer."""
    p = projected(device, seed=1)
    ids, weights = rasterize_top_contributing_gaussian_ids(*lists(p), samples)
    assert ids.shape == (2, HEIGHT, WIDTH, samples)
    assert ids.dtype == torch.int32
    for (true_ids, true), one, weight in zip(
        true_weights(p), ids.flatten(0, 2).cpu(), weights.flatten(0, 2).cpu(), strict=True
    ):
        kept = torch.sort(torch.argsort(true, descending=True, stable=True)[:samples]).values
        assert torch.equal(one[: len(kept)].long(), true_ids[kept])
        torch.testing.assert_close(weight[: len(kept)], true[kept], rtol=1e-10, atol=1e-12)
        assert (one[len(kept) :] == -1).all()


def chosen_pixels(device: torch.device) -> tuple[Tensor, Tensor]:
    """Some pixels of both images in no order, most of them in few tiles; the last ones of the image too."""
    generator = torch.Generator().manual_seed(0)
    places = torch.randperm(2 * HEIGHT * WIDTH, generator=generator)
    places = places[((places % WIDTH) < 8) | (places % 97 == 0)]
    places = torch.cat([places, torch.tensor([HEIGHT * WIDTH - 1])]).unique()
    places = places[torch.randperm(len(places), generator=generator)].to(device)
    in_image = places % (HEIGHT * WIDTH)
    return torch.stack([in_image // WIDTH, in_image % WIDTH], -1), places // (HEIGHT * WIDTH)


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


def test_chosen_pixels_are_those_of_whole_images(device: torch.device) -> None:
    """Colours, alphas and gradients; contributors, too. Only pairs of their tiles are listed."""
    p, (pixels, image_ids) = projected(device), chosen_pixels(device)
    backgrounds = torch.rand(2, 3, dtype=torch.float64, device=device)
    layout = build_sparse_tile_layout(pixels, image_ids, 2, TILE, *TILES)
    offsets, flatten_ids = isect_tiles_sparse(
        p["means2d"], p["radii"], p["depths"], layout.active_tile_mask, layout.active_tiles, 2, TILE, *TILES
    )
    assert offsets[-1] == len(flatten_ids) < len(p["flatten_ids"])
    of_tiles = (layout.active_tiles, offsets, flatten_ids, layout.tile_pixel_mask, layout.tile_pixel_cumsum)
    size = (WIDTH, HEIGHT, TILE, *TILES)
    gaussians = [p["means2d"], p["conics"], p["colors"], p["opacities"]]
    colors, alphas = rasterize_to_pixels_sparse(*gaussians, image_ids, *of_tiles, layout.pixel_map, *size, backgrounds)
    image, whole_alphas = rasterize_to_pixels(
        *gaussians, WIDTH, HEIGHT, TILE, p["offsets"], p["flatten_ids"], backgrounds
    )
    at = (image_ids, pixels[:, 0], pixels[:, 1])
    assert torch.equal(colors, image[at])
    assert torch.equal(alphas, whole_alphas[at])
    upstream = torch.randn(colors.shape, dtype=torch.float64).to(device)
    found = torch.autograd.grad((colors * upstream).sum(), gaussians[:2], retain_graph=True)
    expected = torch.autograd.grad((image[at] * upstream).sum(), gaussians[:2])
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)

    shown = (p["means2d"], p["conics"], p["opacities"])
    counts, _ = rasterize_num_contributing_gaussians_sparse(*shown, *of_tiles, layout.pixel_map, *size)
    whole_counts, _ = rasterize_num_contributing_gaussians(*lists(p))
    assert torch.equal(counts, whole_counts[at])
    ids, weights = rasterize_contributing_gaussian_ids_sparse(*shown, *of_tiles, layout.pixel_map, counts, *size)
    whole = rasterize_contributing_gaussian_ids(*lists(p), whole_counts)
    assert torch.equal(ids, whole[0][at][:, : ids.shape[1]])
    assert torch.equal(weights, whole[1][at][:, : ids.shape[1]])
    top, _ = rasterize_top_contributing_gaussian_ids_sparse(*shown, *of_tiles, layout.pixel_map, *size, 2)
    with pytest.raises(UserError, match="num_depth_samples must be at least 1"):
        rasterize_top_contributing_gaussian_ids_sparse(*shown, *of_tiles, layout.pixel_map, *size, 0)
    assert torch.equal(top, rasterize_top_contributing_gaussian_ids(*lists(p), 2)[0][at])


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
    colors, alphas = rasterize_to_pixels_sparse(
        *gaussians, none[:, 0], *of_tiles, layout.pixel_map, WIDTH, HEIGHT, TILE, *TILES
    )
    assert colors.shape == (0, 3)
    assert alphas.shape == (0, 1)


def test_mistakes_are_told() -> None:
    """One sentence that says what was expected."""
    p = projected(torch.device("cpu"))
    with pytest.raises(UserError, match="num_depth_samples must be at least 1"):
        rasterize_top_contributing_gaussian_ids(*lists(p), 0)
    with pytest.raises(UserError, match="too few for 23 x 50 px"):
        rasterize_num_contributing_gaussians(*lists(p)[:6], 50, TILE)
    with pytest.raises(UserError, match="conics must have shape"):
        rasterize_num_contributing_gaussians(p["means2d"], p["opacities"], *lists(p)[2:])
    twice = torch.tensor([[1, 2], [1, 2]])
    with pytest.raises(UserError, match="must not hold a pixel twice"):
        build_sparse_tile_layout(twice, torch.zeros(2), 1, TILE, *TILES)
    with pytest.raises(UserError, match="found one outside"):
        build_sparse_tile_layout(twice, torch.tensor([0, 1]), 1, TILE, *TILES)
    with pytest.raises(UserError, match=r"pixels must have shape \[P, 2\]"):
        build_sparse_tile_layout(twice[0], torch.zeros(2), 1, TILE, *TILES)
