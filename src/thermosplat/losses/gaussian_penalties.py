"""Penalties on the Gaussians themselves: small and faint where the images do not say otherwise. 3DGS-MCMC, section 3.

Means in place of the publication's sums, as its code has them, so that a weight does not depend on the number of
Gaussians. The opacities of several spectra stand against an image loss each, so their penalties are added. Scales are
measured in scene extents, so that a weight means the same in every capture's units (gsplat normalises the capture).

The means are over the Gaussians that a step sees. Adam divides a gradient by its own size, so where a penalty is all
the gradient that a Gaussian has, the Gaussian fades at the full rate, however small the weight. Over all Gaussians, as
the publication has them, that happens to those that were just added, until a view sees them: in captures whose views
each see a small part of the scene all Gaussians fade, and the scene is lost (benchmarks/records/real-captures.md). On
average over the steps the gradient is the same.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from thermosplat.config import LossConfig
from thermosplat.fused.gaussian_penalties import mean_opacity_and_scale
from thermosplat.scene.gaussians import Gaussians, StoredOpacity


def gaussian_penalties(
    gaussian_sets: Mapping[str, Gaussians],
    config: LossConfig,
    scene_extent: float,
    seen: Mapping[str, Tensor],
    numbers: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:
    """The weighted penalties of some sets together; one whose weight is 0 is not listed.

    Args:
        gaussian_sets: By name, the sets that the step trains.
        scene_extent: Radius of the cameras [world units].
        seen: By name of the set, which Gaussians the step sees, bool [N].
        numbers: By name of the set, how many of them all processes see together, scalars; None: this is the only one.

    Returns:
        Scalars by term, "opacity_reg" and "scale_reg".
    """
    if not (config.opacity_reg > 0 or config.scale_reg > 0):
        return {}
    opacities, scales = [], []
    for set_name, gaussians in gaussian_sets.items():
        of_set = seen[set_name]
        number = of_set.sum() if numbers is None else numbers[set_name]
        second, *others = gaussians.second_opacities or (None,)
        stored = StoredOpacity(None, False) if second is None else gaussians.stored_opacity(second)
        opacity, scale = mean_opacity_and_scale(
            gaussians.log_scales, gaussians.logit_opacities, *stored, of_set, number
        )
        further = (torch.where(of_set, gaussians.opacities_in(name), 0.0).sum() for name in others)
        opacities += [opacity, *(total / number.clamp(min=1) for total in further)]
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


def feature_norm_loss(features: Tensor) -> Tensor:
    """Mean over the Gaussians of (|f| - 1)²: features stay near unit length. MS-Splatting.

    Args:
        features: Latent features, shape [N, d].

    Returns:
        The loss, a scalar.
    """
    return (features.norm(dim=-1) - 1.0).square().mean()
