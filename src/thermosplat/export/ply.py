"""Gaussians as PLY, in the layout of the original 3D Gaussian Splatting code that third-party viewers open.

One vertex a Gaussian, 62 float32 properties, binary little endian: position, a zero normal, SH degree 0, SH degrees 1
to 3 channel by channel (padded with zeros where the model has fewer), opacity and scales before their activation, and
the wxyz quaternion. Positions are in the frame of the capture's own camera poses (COLMAP's, for a COLMAP model).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from thermosplat.runs.atomic_writes import write_atomically
from thermosplat.scene.packed_parameters import sh_degrees
from warp_kernels.constants import SH_DEGREE_MAX

REST_COEFFICIENTS = (SH_DEGREE_MAX + 1) ** 2 - 1  # SH degrees 1 to the highest


def properties(rest_coefficients: int) -> tuple[str, ...]:
    """Names in file order.

    Args:
        rest_coefficients: SH coefficients of a channel above degree 0: 0, 3, 8 or 15.
    """
    return (
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * rest_coefficients)),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    )


PROPERTIES = properties(REST_COEFFICIENTS)
INVISIBLE_OPACITY = 1.0 / 255.0
"""Fainter Gaussians never reach the renderer's smallest blended alpha, 1/255 (3DGS, gsplat)."""


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
    """SH coefficients of degrees 1 and up, shape [N, K-1, 3], K <= 16."""


@dataclass(frozen=True)
class WrittenPly:
    """What became of the Gaussians."""

    path: Path
    """The file."""
    num_gaussians: int
    """Gaussians in the file."""
    num_dropped: int
    """Gaussians left out: a value that is not finite, or an opacity below 1/255."""


@torch.no_grad()
def write_splats(path: Path, splats: Splats, comments: Iterable[str] = (), *, compact: bool = False) -> WrittenPly:
    """Write Gaussians as PLY; the file appears at once and whole.

    Args:
        path: Where to write; its folder is made where there is none.
        splats: The Gaussians.
        comments: Lines for the header; text outside ASCII is written as "?".
        compact: Leave out the SH degrees that are zero everywhere.

    Returns:
        The path and how many Gaussians went in and were left out.
    """
    rest = _used_coefficients(splats.shN) if compact else REST_COEFFICIENTS
    table = _table(splats, rest)
    drawable = _drawable(table, splats.logit_opacities).cpu().numpy()
    rows = table.cpu().numpy()[drawable].astype("<f4", copy=False)  # chosen on the host: no second table on the device
    header = _header(len(rows), comments, properties(rest))

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            file.write(header)
            file.write(rows.data)  # as they lie in memory: so large a write goes past the file's buffer

    write_atomically(path, write)
    return WrittenPly(path, len(rows), len(table) - len(rows))


def _used_coefficients(shN: Tensor) -> int:
    """Coefficients of a channel above degree 0, up to the highest degree that is not zero everywhere."""
    degree = int(sh_degrees(shN).max()) if shN.numel() > 0 else 0
    return (degree + 1) ** 2 - 1


def _table(splats: Splats, rest_coefficients: int) -> Tensor:
    """All properties in file order, float32 [N, properties], where the Gaussians are."""
    count, bases = len(splats.shN), min(splats.shN.shape[1], rest_coefficients)
    widths = (3, 3, 3, 3 * rest_coefficients, 1, 3, 4)
    table = torch.zeros(count, sum(widths), device=splats.means.device)
    means, _, sh0, rest, logit_opacities, log_scales, quats = table.split(widths, dim=1)
    means[:] = splats.means
    sh0[:] = splats.sh0.reshape(count, 3)
    # the file runs through a channel's bases, then the next
    rest.view(count, 3, rest_coefficients)[..., :bases] = splats.shN[:, :bases].transpose(1, 2)
    logit_opacities[:] = splats.logit_opacities.reshape(count, 1)
    log_scales[:] = splats.log_scales
    quats[:] = torch.nn.functional.normalize(splats.quats, dim=-1)  # not every viewer normalises
    return table


def _drawable(table: Tensor, logit_opacities: Tensor) -> Tensor:
    """Mask [N] of the rows that a viewer can show: all values finite, and not too faint."""
    lowest, highest = torch.aminmax(table, dim=1)  # NaN where there is one
    return torch.isfinite(lowest) & torch.isfinite(highest) & (torch.sigmoid(logit_opacities) >= INVISIBLE_OPACITY)


def _header(count: int, comments: Iterable[str], names: Iterable[str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(comment.split())}" for comment in comments]
    lines += [f"element vertex {count}", *(f"property float {name}" for name in names), "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii", errors="replace")
