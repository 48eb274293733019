"""Penalties on the Gaussians themselves: small and faint where the images do not say otherwise. 3DGS-MCMC, section 3.

Means in place of the publication's sums, as its code has them, so that a weight does not depend on the number of
Gaussians. The opacities of the two spectra stand against an image loss each, so their penalties are added. Scales are
measured in scene extents, so that a weight means the same in every capture's units (gsplat normalises the capture).
"""

from collections.abc import Mapping

from torch import Tensor

from thermosplat.config import LossConfig
from thermosplat.gaussians import Gaussians


def gaussian_penalties(
    gaussian_sets: Mapping[str, Gaussians], config: LossConfig, scene_extent: float
) -> dict[str, Tensor]:
    """The weighted penalties of all sets together; one whose weight is 0 is not computed and not listed.

    Args:
        gaussian_sets: The sets by name.
        config: The weights.
        scene_extent: Radius of the cameras [world units].

    Returns:
        Scalars by term, "opacity_reg" and "scale_reg".
    """
    sets = list(gaussian_sets.values())
    penalties: dict[str, Tensor] = {}
    if config.opacity_reg > 0:
        penalties["opacity_reg"] = config.opacity_reg * _total([opacity_penalty(gaussians) for gaussians in sets])
    if config.scale_reg > 0:
        scales = _total([gaussians.scales.mean() for gaussians in sets])
        penalties["scale_reg"] = (config.scale_reg / scene_extent) * scales
    return penalties


def opacity_penalty(gaussians: Gaussians) -> Tensor:
    """Mean of α, and in a set with two opacities plus the mean of α_t; a scalar from 0 to 2."""
    visible = gaussians.opacities.mean()
    return visible + gaussians.thermal_opacities.mean() if gaussians.has_two_opacities else visible


def _total(penalties: list[Tensor]) -> Tensor:
    total = penalties[0]
    for penalty in penalties[1:]:
        total = total + penalty
    return total
