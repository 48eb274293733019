"""gsplat's ``rasterize_to_pixels``."""

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import check_shape
from thermosplat.rasterizer.graph_breaks import not_compiled
from thermosplat.rasterizer.steps.given_lists import GivenScene
from warp_kernels.constants import CHANNELS_MAX


@not_compiled
def rasterize_to_pixels(
    means2d: Tensor,  # [..., N, 2] or [nnz, 2]
    conics: Tensor,  # [..., N, 3] or [nnz, 3]
    colors: Tensor,  # [..., N, channels] or [nnz, channels]
    opacities: Tensor,  # [..., N] or [nnz]
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,  # [..., tile_height, tile_width]
    flatten_ids: Tensor,  # [n_isects]
    backgrounds: Tensor | None = None,  # [..., channels]
    masks: Tensor | None = None,  # [..., tile_height, tile_width]
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Blends projected Gaussians to images; gsplat's function.

    Differentiable in means2d, conics, colors, opacities and backgrounds. ``rasterization`` keeps the conics' roots,
    which are exact for long needles too; here they are made of the conics, whose rounding moves what a needle of
    float32 that is a thousand times longer than wide looks like.

    Args:
        means2d: [..., N, 2], or packed [nnz, 2], px.
        conics: Inverse 2D covariances xx, xy, yy, [..., N, 3] or [nnz, 3], 1/px².
        colors: Of any number of channels, [..., N, channels] or [nnz, channels].
        opacities: [..., N] or [nnz].
        image_width: [px].
        image_height: [px].
        tile_size: 8, 16 or 32 [px].
        isect_offsets: First pair of each tile, int32 [..., tile_height, tile_width].
        flatten_ids: Flat index of each pair's Gaussian, int32 [n_isects].
        backgrounds: Colours behind everything, [..., channels].
        masks: Tiles to draw, bool [..., tile_height, tile_width]; the others show the background.
        packed: The Gaussians are packed; shapes say so anyway.
        absgrad: Absolute gradients of pixels add up in ``means2d.absgrad`` (AbsGS).

    Returns:
        ``(render_colors, render_alphas)``: [..., H, W, channels] and [..., H, W, 1].

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    lists = (isect_offsets, flatten_ids, masks)
    scene = GivenScene(means2d, conics, opacities, image_width, image_height, tile_size, *lists)
    lead, rows = tuple(means2d.shape[:-1]), means2d.numel() // 2
    if not packed and lead[:-1] != scene.images_shape:
        raise UserError(
            f"means2d has the images {list(lead[:-1])}, isect_offsets has {list(scene.images_shape)}.",
            "Give packed=True with packed Gaussians.",
        )
    check_shape("colors", colors, (*lead, *colors.shape[-1:]), means2d, "[..., N, channels]")
    if absgrad:
        scene.shown_means2d = means2d
    features = colors.reshape(rows, colors.shape[-1]).contiguous()
    blended = scene.blend_in_chunks(features, CHANNELS_MAX, absgrad)
    render_colors = blended.render
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (*scene.images_shape, colors.shape[-1]), means2d)
        render_colors = torch.addcmul(render_colors, blended.transmittance, backgrounds[..., None, None, :])
    return render_colors, blended.alphas
