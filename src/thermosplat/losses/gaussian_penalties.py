"""Penalties on the Gaussians themselves: small and faint where the images do not say otherwise. 3DGS-MCMC, section 3.

Means in place of the publication's sums, as its code has them, so that a weight does not depend on the number of
Gaussians. The opacities of several spectra stand against an image loss each, so their penalties are added. Scales are
measured in scene extents, so that a weight means the same in every capture's units (gsplat normalises the capture).
"""

from collections.abc import Mapping

from torch import Tensor

from thermosplat.config import LossConfig
from thermosplat.fused.gaussian_penalties import mean_opacity_and_scale
from thermosplat.scene.gaussians import Gaussians, StoredOpacity


def gaussian_penalties(
    gaussian_sets: Mapping[str, Gaussians], config: LossConfig, scene_extent: float
) -> dict[str, Tensor]:
    """The weighted penalties of some sets together; one whose weight is 0 is not listed.

    Args:
        gaussian_sets: By name, the sets that the step trains.
        config: The weights.
        scene_extent: Radius of the cameras [world units].

    Returns:
        Scalars by term, "opacity_reg" and "scale_reg".
    """
    if not (config.opacity_reg > 0 or config.scale_reg > 0):
        return {}
    opacities, scales = [], []
    for gaussians in gaussian_sets.values():
        second, *others = gaussians.second_opacities or (None,)
        stored = StoredOpacity(None, False) if second is None else gaussians.stored_opacity(second)
        opacity, scale = mean_opacity_and_scale(gaussians.log_scales, gaussians.logit_opacities, *stored)
        opacities += [opacity, *(gaussians.opacities_in(name).mean() for name in others)]
        scales.append(scale)
    penalties: dict[str, Tensor] = {}
    if config.opacity_reg > 0:
        penalties["opacity_reg"] = config.opacity_reg * _total(opacities)
    if config.scale_reg > 0:
        penalties["scale_reg"] = (config.scale_reg / scene_extent) * _total(scales)
    return penalties


def _total(penalties: list[Tensor]) -> Tensor:
    total = penalties[0]
    for penalty in penalties[1:]:
        total = total + penalty
    return total
