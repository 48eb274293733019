"""Gaussians as PLY, in the layout of the original 3D Gaussian Splatting code that third-party viewers open.

One vertex per Gaussian, 62 float32 properties, binary little endian: position, a zero normal, SH degree 0, SH degrees 1
to 3 channel by channel (padded with zeros where the model has fewer; with degree 4 there are 89 properties, which few
viewers read), opacity and scales before their activation, and the wxyz quaternion. Positions are in the frame of the
capture's own camera poses (COLMAP's, for a COLMAP model).
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from thermosplat.export.splats import Splats, WrittenSplats, is_drawable, used_coefficients
from thermosplat.runs.atomic_writes import write_atomically

REST_COEFFICIENTS = 15  # of SH degrees 1 to 3, which viewers expect


def properties(rest_coefficients: int) -> tuple[str, ...]:
    """Names in file order.

    Args:
        rest_coefficients: SH coefficients of a channel above degree 0: 0, 3, 8, 15 or 24.
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


@torch.no_grad()
def write_splats(
    path: Path,
    splats: Splats,
    comments: Iterable[str] = (),
    *,
    compact: bool = False,
    scalars: Mapping[str, Tensor] | None = None,
) -> WrittenSplats:
    """Write Gaussians as PLY; the file appears at once and whole.

    Args:
        path: Where to write; its folder is made where there is none.
        comments: Lines for the header; text outside ASCII is written as "?".
        compact: Leave out the SH degrees that are zero everywhere.
        scalars: Further properties by name, [N] each, behind the others. CloudCompare shows them as scalar fields
            where their names begin with "scalar_". Some viewers want the 62 properties and no more.

    Returns:
        The path and how many Gaussians went in and were left out.
    """
    used = used_coefficients(splats.shN)
    rest = used if compact else max(used, REST_COEFFICIENTS)
    table = _table(splats, rest)
    drawable = is_drawable(table, splats.logit_opacities).cpu().numpy()
    further = scalars or {}
    if further:
        table = torch.cat([table, *(values[:, None].to(table) for values in further.values())], dim=1)
    rows = table.cpu().numpy()[drawable].astype("<f4", copy=False)  # chosen on the host: no second table on the device
    header = _header(len(rows), comments, (*properties(rest), *further))

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            file.write(header)
            file.write(rows.data)  # as they lie in memory: so large a write goes past the file's buffer

    write_atomically(path, write)
    return WrittenSplats(path, len(rows), len(table) - len(rows))


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


def _header(count: int, comments: Iterable[str], names: Iterable[str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += comment_lines(comments)
    lines += [f"element vertex {count}", *(f"property float {name}" for name in names), "end_header"]
    return ("\n".join(lines) + "\n").encode("ascii", errors="replace")


def comment_lines(comments: Iterable[str]) -> list[str]:
    """Lines of a PLY header that say something to people.

    Args:
        comments: What they say; line ends become spaces.
    """
    return [f"comment {' '.join(comment.split())}" for comment in comments]
