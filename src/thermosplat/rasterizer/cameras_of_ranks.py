"""Cameras of all ranks, which every rank projects its Gaussians to: gathered, each with its lens and shutter."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, groupby, pairwise
from typing import Any, cast, get_args

import torch
from torch import Tensor

from thermosplat.distributed.collectives import GatheredRows, numbers_of_all
from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import check_shape
from thermosplat.rasterizer.call_inputs import CameraModel
from thermosplat.rasterizer.lenses import Lenses
from warp_kernels.projection.lens_models import LENS_COEFFS, LensModel
from warp_kernels.projection.lens_step import LensSettings
from warp_kernels.projection.shutter_motion import MOTION

_MODELS, _LENSES = get_args(CameraModel), get_args(LensModel)
_POSE, _INTRINSICS = 16, 9


@dataclass(frozen=True)
class CameraKind:
    """What cameras must have in common to be rendered by one launch; those of a rank have."""

    width: int
    """Of an image [px]."""
    height: int
    """Likewise."""
    camera_model: CameraModel
    """As ``rasterization``'s."""
    lens: LensSettings | None
    """None: there is neither lens nor rolling shutter."""

    def numbers(self) -> list[float]:
        """As numbers, exact in float64."""
        lens = -1 if self.lens is None else _LENSES.index(self.lens.model)
        shutter = None if self.lens is None else self.lens.shutter
        times = (math.nan,) * 3 if shutter is None else shutter
        return [self.width, self.height, _MODELS.index(self.camera_model), lens, *times]

    @classmethod
    def of_numbers(cls, numbers: Sequence[float]) -> "CameraKind":
        """The inverse of ``numbers``."""
        width, height, camera_model, lens = map(int, numbers[:4])
        a, b, c = numbers[4:]
        shutter = None if math.isnan(a) else (a, b, c)
        return cls(width, height, _MODELS[camera_model], LensSettings(_LENSES[lens], shutter) if lens >= 0 else None)


@dataclass(frozen=True)
class CamerasOfRanks:
    """The cameras of all ranks, rank 0's first."""

    counts: list[int]
    kinds: list[CameraKind]
    """Of each camera, [C_world]."""
    most_gaussians: int
    """Of the rank that has the most."""
    rows: Tensor
    """View matrix, intrinsics, and where some rank has them lens, motion and second view matrix, [C_world, X]."""

    def by_kind(self) -> Iterator[tuple[dict[str, Any], Lenses | None, slice]]:
        """Neighbours of one kind, which are rendered by one launch.

        Fields of their ``Cameras``, lenses, and which cameras they are; the last ones to the end, so that values for
        more cameras than there are do not fit.
        """
        columns = [_POSE, _INTRINSICS, LENS_COEFFS, MOTION, _POSE]
        edges = list(pairwise([0, *accumulate(columns)]))
        start = 0
        for kind, group in groupby(self.kinds):
            stop = start + len(list(group))
            poses, intrinsics, coefficients, motions, later_poses = (
                self.rows[start:stop, first:beyond] for first, beyond in edges
            )
            viewmats, lenses = poses.reshape(-1, 4, 4), None
            if kind.lens is not None and kind.lens.shutter is not None:
                lenses = Lenses(kind.lens, coefficients, motions, later_poses.reshape(-1, 4, 4))
            elif kind.lens is not None:
                lenses = Lenses(kind.lens, coefficients, None, viewmats)
            which = slice(start, stop if stop < len(self.kinds) else None)
            size = {"width": kind.width, "height": kind.height, "camera_model": kind.camera_model}
            yield {"viewmats": viewmats, "Ks": intrinsics.reshape(-1, 3, 3), **size}, lenses, which
            start = stop


def check_cameras(means: Tensor, viewmats: Tensor, Ks: Tensor) -> None:
    """Check the cameras of a rank.

    Args:
        means: This rank's Gaussians, [N, 3].
        viewmats: Its cameras, [C, 4, 4]; there may be none.
        Ks: Their intrinsics, [C, 3, 3].

    Raises:
        UserError: Something has another shape.
    """
    if means.dim() != 2:
        raise UserError(f"means must have shape [N, 3] with distributed=True, got {list(means.shape)}: one scene.")
    if not isinstance(viewmats, Tensor) or viewmats.dim() != 3:
        found = list(viewmats.shape) if isinstance(viewmats, Tensor) else type(viewmats).__name__
        raise UserError(f"viewmats must have shape ['C', 4, 4], got {found}.")
    own = len(viewmats)
    check_shape("viewmats", viewmats, (own, 4, 4), means, "[C, 4, 4]")
    check_shape("Ks", Ks, (own, 3, 3), means, "[C, 3, 3] with C from viewmats")


def cameras_of_ranks(
    viewmats: Tensor, Ks: Tensor, kind: CameraKind, lenses: Lenses | None, num_gaussians: int
) -> CamerasOfRanks:
    """The cameras of all ranks; their gradients reach the rank that gave them.

    Args:
        viewmats: This rank's, [C, 4, 4].
        Ks: Their intrinsics, [C, 3, 3].
        lenses: Their lenses and motions; None where the kind has none.

    Raises:
        UserError: No rank has a camera.
    """
    own = len(viewmats)
    columns = [viewmats.reshape(own, _POSE), Ks.reshape(own, _INTRINSICS)]
    if lenses is not None:
        columns.append(lenses.coefficients.reshape(own, LENS_COEFFS))
        if lenses.motions is not None:
            columns += [lenses.motions.reshape(own, MOTION), lenses.viewmats.reshape(own, _POSE)]
    cameras = torch.cat(columns, dim=1)
    about = [own, num_gaussians, int(cameras.requires_grad), cameras.shape[1], *kind.numbers()]
    said = numbers_of_all(about, viewmats.device)
    counts = [int(count) for count, *_ in said]
    if sum(counts) == 0:
        raise UserError("No rank has a camera to render with distributed=True.")
    widest = max(int(width) for _, _, _, width, *_ in said)
    cameras = torch.nn.functional.pad(cameras, (0, widest - cameras.shape[1]))
    if any(wanted for _, _, wanted, *_ in said) and not cameras.requires_grad:
        cameras = cameras.detach().requires_grad_()  # every rank takes part in what another one's gradient needs
    rows = cast("Tensor", GatheredRows.apply(cameras, counts))
    kinds = [CameraKind.of_numbers(numbers) for count, _, _, _, *numbers in said for _ in range(int(count))]
    return CamerasOfRanks(counts, kinds, max(int(number) for _, number, *_ in said), rows)
