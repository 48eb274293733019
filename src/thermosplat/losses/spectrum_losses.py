"""Losses on the image of a spectrum beside L1 and SSIM, each with a weight among the spectrum's settings."""

from collections.abc import Callable

from kornia.losses import total_variation
from torch import Tensor


def smoothness(image: Tensor, target: Tensor | None = None) -> Tensor:
    """Mean over pixels and channels of |∂x| + |∂y|, forward differences without wrap-around (equation 12).

    Normalised by H·W·C, as ThermalGaussian does; kornia's own mean would divide each direction by the number of its
    differences instead.

    Args:
        image: Image, shape [H, W, C].
        target: Not looked at.

    Returns:
        The smoothness term, a scalar.
    """
    return total_variation(image.permute(2, 0, 1), reduction="sum").sum() / image.numel()


SPECTRUM_LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"smoothness": smoothness}
"""By the field of ``SpectrumConfig`` that weighs it, each loss as a function of the render and its image, [H, W, C].
``losses.image_terms`` calls the term "<spectrum>_<field>"."""
