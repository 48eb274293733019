"""Loss weights that follow the numbers of Gaussians of separate sets: ThermalGaussian's regularisation of MSMG.

The larger a spectrum's set, the less its losses weigh, and with them the gradients that densification compares with its
threshold: the sets hold each other's growth in check. (Adam's updates hardly depend on the scale of a loss.)
"""

from collections.abc import Mapping

from torch import Tensor


def balanced_losses(
    losses: Mapping[str, Tensor], spectra: Mapping[str, str], num_gaussians: Mapping[str, int]
) -> dict[str, Tensor]:
    """Loss terms, each multiplied by the share of all Gaussians that the other spectra have, mean over those.

    Args:
        losses: Weighted terms by name.
        spectra: The spectrum of each term that is one spectrum's.
        num_gaussians: Gaussians by spectrum, whose set it is; two at least.

    Returns:
        The same terms. With two sets of one size every factor is 1/2.
    """
    total, others = sum(num_gaussians.values()), len(num_gaussians) - 1
    factors = {name: (total - count) / (total * others) for name, count in num_gaussians.items()}
    return {name: factors[spectra[name]] * loss if name in spectra else loss for name, loss in losses.items()}
