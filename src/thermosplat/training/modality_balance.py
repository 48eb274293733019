"""Loss weights that follow the numbers of Gaussians of two sets: ThermalGaussian's regularisation of MSMG.

The larger a spectrum's set, the less its losses weigh, and with them the gradients that densification compares with its
threshold: the sets hold each other's growth in check. (Adam's updates hardly depend on the scale of a loss.)
"""

from collections.abc import Mapping

from torch import Tensor


def balanced_losses(losses: Mapping[str, Tensor], num_gaussians: Mapping[str, int]) -> dict[str, Tensor]:
    """Loss terms, each multiplied by the other spectrum's share of all Gaussians.

    Args:
        losses: Weighted terms by name; those whose name starts with "thermal" belong to the thermal set.
        num_gaussians: Gaussians by the name of the set, "rgb" and "thermal".

    Returns:
        The same terms. With sets of one size every factor is 1/2.
    """
    total = sum(num_gaussians.values())
    factors = {"rgb": num_gaussians["thermal"] / total, "thermal": num_gaussians["rgb"] / total}
    return {name: factors["thermal" if name.startswith("thermal") else "rgb"] * loss for name, loss in losses.items()}
