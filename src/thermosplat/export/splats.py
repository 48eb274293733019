"""Gaussians with spherical-harmonic colours: what programs for splats draw, and what all their formats hold.

Formats differ in units, quantisation and axes; they agree on these parameters. Whoever reads one of our files gets the
Gaussians in the frame of the capture's own poses (:func:`in_world`), or in that frame turned by half a turn about x, so
that y points up (:func:`turned_y_up`): docs/conventions.md has the table.
"""

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from thermosplat.datasets.placement import Placement
from thermosplat.scene.packed_parameters import sh_degrees

INVISIBLE_OPACITY = 1.0 / 255.0
"""Fainter Gaussians never reach the renderer's smallest blended alpha, 1/255 (3DGS, gsplat)."""
SH_SIGNS_OF_HALF_TURN = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, 1, -1, 1)
"""Signs of the basis functions of degrees 1 to 4 where y and z change theirs: those with an odd power of y z flip."""
_GRID_BITS = 21
"""Bits of a coordinate in a Morton code of 63 bits."""


@dataclass(frozen=True)
class Splats:
    """Gaussians that carry spherical-harmonic colours only: what a third-party viewer can draw."""

    means: Tensor
    """Centres [world units], shape [N, 3]."""
    quats: Tensor
    """Rotations wxyz, not necessarily normalised, shape [N, 4]."""
    log_scales: Tensor
    """Logarithms of the standard deviations [world units], shape [N, 3]."""
    logit_opacities: Tensor
    """Opacities before the sigmoid, shape [N]."""
    sh0: Tensor
    """SH coefficients of degree 0, shape [N, 1, 3]."""
    shN: Tensor
    """SH coefficients of degrees 1 and up, shape [N, K-1, 3], K <= 25."""


@dataclass(frozen=True)
class WrittenSplats:
    """What became of the Gaussians."""

    path: Path
    num_gaussians: int
    num_dropped: int
    """Gaussians left out: a value that is not finite, or an opacity below 1/255."""


@dataclass(frozen=True)
class SplatArrays:
    """Gaussians that a viewer can show, on the host: all values finite, opaque enough, quaternions of length 1."""

    means: NDArray[np.float32]
    """Centres, [M, 3]."""
    quats: NDArray[np.float32]
    """Rotations wxyz of length 1, [M, 4]."""
    log_scales: NDArray[np.float32]
    """Logarithms of the standard deviations, [M, 3]."""
    logit_opacities: NDArray[np.float32]
    """Opacities before the sigmoid, [M]."""
    sh0: NDArray[np.float32]
    """SH coefficients of degree 0, [M, 3]."""
    shN: NDArray[np.float32]
    """SH coefficients up to the highest degree in use, [M, (degree + 1)² - 1, 3]."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest degree in use, 0 to 4."""
        return int(np.sqrt(self.shN.shape[1] + 1)) - 1

    @property
    def opacities(self) -> NDArray[np.float32]:
        """Opacities in (0, 1), [M]."""
        return (1.0 / (1.0 + np.exp(-self.logit_opacities.astype(np.float64)))).astype(np.float32)

    def __getitem__(self, order: NDArray[np.intp]) -> "SplatArrays":
        """The Gaussians of some indices, in their order."""
        return SplatArrays(*(getattr(self, field.name)[order] for field in fields(self)))


def in_world(splats: Splats, placement: Placement) -> Splats:
    """Gaussians of a scene as files have them: in world units, from the scene's origin.

    Far from the world's origin float32 has no digits for them. There the scene's origin is subtracted from the world's
    coordinates, and ``export_frame`` says so.

    Args:
        splats: In the scene's frame.
    """
    if placement.unit == 1.0:
        return splats
    return replace(splats, means=placement.unit * splats.means, log_scales=splats.log_scales + math.log(placement.unit))


@torch.no_grad()
def drawable(splats: Splats) -> SplatArrays:
    """The Gaussians that a viewer can show, in their order.

    Args:
        splats: All of them; those with a value that is not finite or an opacity below 1/255 are left out.
    """
    used = used_coefficients(splats.shN)
    columns = [
        splats.means,
        torch.nn.functional.normalize(splats.quats, dim=-1),
        splats.log_scales,
        splats.logit_opacities[:, None],
        splats.sh0[:, 0],
        splats.shN[:, :used].flatten(1),
    ]
    table = torch.cat([column.float() for column in columns], dim=1)
    rows = table[is_drawable(table, splats.logit_opacities)].cpu().numpy()
    ends = np.cumsum([column.shape[1] for column in columns])[:-1]
    means, quats, log_scales, logits, sh0, shN = np.split(rows, ends, axis=1)
    return SplatArrays(means, quats, log_scales, logits[:, 0], sh0, shN.reshape(len(rows), used, 3))


def is_drawable(table: Tensor, logit_opacities: Tensor) -> Tensor:
    """Mask [N] of the rows that a viewer can show: all values finite, and not too faint.

    Args:
        table: All values of each Gaussian, [N, X].
        logit_opacities: Its opacity before the sigmoid, [N].
    """
    lowest, highest = torch.aminmax(table, dim=1)  # NaN where there is one
    return torch.isfinite(lowest) & torch.isfinite(highest) & (torch.sigmoid(logit_opacities) >= INVISIBLE_OPACITY)


def used_coefficients(shN: Tensor) -> int:
    """Coefficients of a channel above degree 0, up to the highest degree that is not zero everywhere.

    Args:
        shN: SH coefficients of degrees 1 and up, [N, K-1, 3].
    """
    degree = int(sh_degrees(shN).max()) if shN.numel() > 0 else 0
    return (degree + 1) ** 2 - 1


def turned_y_up(splats: SplatArrays) -> SplatArrays:
    """Gaussians after half a turn about x: from OpenCV's axes (y down, z forward) to y up and z backward.

    Args:
        splats: In the frame of the capture's poses.
    """
    half_turn = np.array([1, -1, -1], np.float32)
    w, x, y, z = splats.quats.T
    return SplatArrays(
        splats.means * half_turn,
        np.stack([-x, w, -z, y], axis=1),  # (0, 1, 0, 0) times the quaternion
        splats.log_scales,
        splats.logit_opacities,
        splats.sh0,
        splats.shN * np.array(SH_SIGNS_OF_HALF_TURN, np.float32)[: splats.shN.shape[1], None],
    )


def morton_order(means: NDArray[np.float32]) -> NDArray[np.intp]:
    """Indices [M] that sort points along a Z-order curve: neighbours in a file are neighbours in space.

    Args:
        means: Points, [M, 3].
    """
    if len(means) == 0:
        return np.zeros(0, np.intp)
    low, high = means.min(axis=0), means.max(axis=0)
    cells = ((means - low) / np.maximum(high - low, 1e-30) * ((1 << _GRID_BITS) - 1)).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(code, kind="stable")


def _spread(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The lowest 21 bits with two zeros between each pair (Morton codes by masks and shifts)."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
    return bits
