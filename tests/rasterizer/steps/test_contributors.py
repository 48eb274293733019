"""Contributors of pixels against dense torch."""

from typing import Any

import pytest
import torch
from torch import Tensor

from listed_gaussians import HEIGHT, TILE, TILES, WIDTH, listed, projected
from thermosplat import UserError, rasterize_to_pixels
from thermosplat.rasterizer.steps import (
    rasterize_contributing_gaussian_ids,
    rasterize_num_contributing_gaussians,
    rasterize_top_contributing_gaussian_ids,
)


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


def test_counts_and_lists_are_those_of_the_blending(device: torch.device) -> None:
    """Every pixel's Gaussians, in order, with their weights; alphas are the image's."""
    p = projected(device)
    counts, alphas = rasterize_num_contributing_gaussians(*listed(p))
    ids, weights = rasterize_contributing_gaussian_ids(*listed(p), counts)
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
    ids, weights = rasterize_top_contributing_gaussian_ids(*listed(p), samples)
    assert ids.shape == (2, HEIGHT, WIDTH, samples)
    assert ids.dtype == torch.int32
    for (true_ids, true), one, weight in zip(
        true_weights(p), ids.flatten(0, 2).cpu(), weights.flatten(0, 2).cpu(), strict=True
    ):
        kept = torch.sort(torch.argsort(true, descending=True, stable=True)[:samples]).values
        assert torch.equal(one[: len(kept)].long(), true_ids[kept])
        torch.testing.assert_close(weight[: len(kept)], true[kept], rtol=1e-10, atol=1e-12)
        assert (one[len(kept) :] == -1).all()


def test_mistakes_are_told() -> None:
    """One sentence that says what was expected."""
    p = projected(torch.device("cpu"))
    with pytest.raises(UserError, match="num_depth_samples must be at least 1"):
        rasterize_top_contributing_gaussian_ids(*listed(p), 0)
    with pytest.raises(UserError, match="too few for 23 x 50 px"):
        rasterize_num_contributing_gaussians(*listed(p)[:6], 50, TILE)
    with pytest.raises(UserError, match="conics must have shape"):
        rasterize_num_contributing_gaussians(p["means2d"], p["opacities"], *listed(p)[2:])
