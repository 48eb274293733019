"""How far apart along its ray the Gaussians lie that a pixel is made of, and the penalty on it.

Where a surface has no texture, images do not say how opaque it is: Gaussians behind it that have its colour do as well.
2D Gaussian Splatting (Huang et al. 2024, section 4.2, after Mip-NeRF 360) therefore penalises pairs of Gaussians by
their distance, with the weights w of their blending. Here the distance is that of log z, squared:

    A Σ w s² - (Σ w s)² = ½ Σ_i Σ_j w_i w_j (s_i - s_j)²,     s = log z,     A = Σ w                             (16)

A ratio of depths means the same near and far and in any units, and squares need two more channels in place of a pass of
their own.
"""

import torch
from torch import Tensor

from thermosplat.rendered_frame import RenderedFrame

NEAREST = 0.01
"""Near plane of the renderer [world units]: what is nearer is not drawn, and counts as lying there."""


def log_depth_moments(means: Tensor, viewmat: Tensor) -> Tensor:
    """log z and its square, to be blended like features.

    Args:
        means: Centres, shape [N, 3] [world units].
        viewmat: World to camera, shape [4, 4].

    Returns:
        Shape [N, 2].
    """
    depths = means @ viewmat[2, :3] + viewmat[2, 3]
    logarithms = depths.clamp(min=NEAREST).log()
    return torch.stack([logarithms, logarithms.square()], dim=-1)


def depth_spread(rendered: RenderedFrame, limit: float) -> Tensor:
    """Mean over pixels of v / (1 + v / limit), v being (16), summed over the spectra that were rendered.

    Args:
        rendered: A frame with moments.
        limit: Spread from which on more hardly counts, or 0: no limit.

    Returns:
        A scalar, zero where each pixel sees one depth.
    """
    seen = [(rendered.visible_depths, rendered.rgb_alpha), (rendered.thermal_depths, rendered.thermal_alpha)]
    spreads = [
        alpha.squeeze(-1) * moments[..., 1] - moments[..., 0].square()
        for moments, alpha in seen
        if moments is not None and alpha is not None
    ]
    return torch.stack([(v / (1.0 + v / limit) if limit > 0 else v).mean() for v in spreads]).sum()
