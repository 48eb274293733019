"""gsplat's ``quat_scale_to_covar_preci``: covariances and their inverses from rotations and standard deviations."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from thermosplat.rasterizer.arguments import check_shape

UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
"""Rows and columns of an upper triangle xx, xy, xz, yy, yz, zz."""


def quat_scale_to_covar_preci(
    quats: Tensor,  # [..., 4]
    scales: Tensor,  # [..., 3]
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Covariances R diag(s²) Rᵀ and their inverses; gsplat's function, on the CPU too. Differentiable.

    ``gsplat.MCMCStrategy`` calls it as ``gsplat.strategy.ops.quat_scale_to_covar_preci``.

    Args:
        quats: Rotations (w, x, y, z) of any length, [..., 4].
        scales: Standard deviations, [..., 3].
        compute_covar: Return covariances.
        compute_preci: Return their inverses.
        triu: Return upper triangles, [..., 6].

    Returns:
        ``(covars, precis)``, [..., 3, 3] or [..., 6] each, or None where it was not asked for.

    Raises:
        UserError: an argument has the wrong shape or type.
    """
    check_shape("quats", quats, (*scales.shape[:-1], 4), scales, "[..., 4] with ... from scales")
    w, x, y, z = normalize(quats, dim=-1).unbind(-1)
    entries = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    rotations = torch.stack(entries, -1).unflatten(-1, (3, 3))

    def squared(deviations: Tensor) -> Tensor:
        root = rotations * deviations[..., None, :]
        full = root @ root.transpose(-1, -2)
        return full[..., UPPER[0], UPPER[1]] if triu else full

    return squared(scales) if compute_covar else None, squared(1 / scales) if compute_preci else None
