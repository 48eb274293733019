"""A scene whose Gaussians are divided over ranks, as one of them blends it for its own cameras.

Every rank projects its Gaussians to the cameras of all; ``rasterizer.exchange`` brings what a rank's cameras see to
it, where it is binned and blended like any other scene.
"""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import torch
import torch.distributed as dist
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.blending import BlendedTensors
from thermosplat.rasterizer.cameras_of_ranks import CameraKind, cameras_of_ranks
from thermosplat.rasterizer.exchange import AbsoluteGradients, Exchange
from thermosplat.rasterizer.info import RasterizationInfo, conics, entries_of_seen
from thermosplat.rasterizer.lenses import Lenses
from thermosplat.rasterizer.pair_capacity import active_pair_capacity
from thermosplat.rasterizer.projected_scene import ProjectedScene
from thermosplat.rasterizer.projection import ProjectedTensors
from thermosplat.rasterizer.row_routes import route_in_room, route_of_seen

MOST_ROWS = 2**31
"""Projected Gaussians are numbered with 32 bits."""

MakeScene = Callable[[Tensor, Tensor, CameraKind, Lenses | None, slice], ProjectedScene]
"""Projects this rank's Gaussians to cameras: view matrices, intrinsics, of what kind, their lenses, which of all."""


def scene_among_ranks(
    make: MakeScene, viewmats: Tensor, Ks: Tensor, kind: CameraKind, lenses: Lenses | None, num_gaussians: int
) -> ProjectedScene:
    """What this rank's cameras see of the Gaussians of all ranks.

    Args:
        make: Projects this rank's Gaussians.
        viewmats: This rank's cameras, [C, 4, 4], checked; there may be none.
        Ks: Their intrinsics, [C, 3, 3], checked.
        kind: What they have in common; other ranks may have others.
        lenses: Their lenses.
        num_gaussians: On this rank.

    Raises:
        UserError: No rank has a camera.
    """
    cameras = cameras_of_ranks(viewmats, Ks, kind, lenses, num_gaussians)
    parts = [make(*alike) for alike in cameras.by_kind()]
    sizes = [(of_camera.width, of_camera.height) for of_camera in cameras.kinds]
    return ExchangedScene(parts, cameras.counts, sizes, cameras.most_gaussians, kind.width, kind.height)


class ExchangedScene(ProjectedScene):
    """Gaussians of all ranks as this rank's cameras see them; blended as any ``ProjectedScene``.

    Args:
        parts: This rank's Gaussians projected to the cameras of all ranks, in the order of ranks.
        counts: Cameras of each rank.
        sizes: Width and height of every camera's image [px].
        most_gaussians: Of the rank that has the most.
        width: Of this rank's images [px].
        height: Likewise.

    Raises:
        UserError: a rank's Gaussians before all cameras are too many to be numbered.
    """

    def __init__(
        self,
        parts: list[ProjectedScene],
        counts: list[int],
        sizes: list[tuple[int, int]],
        most_gaussians: int,
        width: int,
        height: int,
    ) -> None:
        first = parts[0]
        cameras, num_gaussians = counts[dist.get_rank()], first.settings.num_gaussians
        if most_gaussians * len(sizes) >= MOST_ROWS:
            raise UserError(
                f"{most_gaussians:,} Gaussians on a rank before {len(sizes)} cameras are more than 2^31 projections.",
                "Use more devices, or a smaller --batch-size.",
            )
        self.tile_size, self.deterministic = first.tile_size, first.deterministic
        self._turns = threading.Lock()
        self._lists = None

        def joined(of: Callable[[ProjectedScene], Tensor]) -> Tensor:
            tensors = [of(part) for part in parts]
            return tensors[0] if len(tensors) == 1 else torch.cat(tensors)

        # What users see: this rank's Gaussians before all cameras, on the path of the gradient.
        self._own_means2d, self._own_depths = joined(lambda part: part.means2d), joined(lambda part: part.depths)
        self._own_opacities = joined(lambda part: part.opacities)
        self._own_extents = joined(lambda part: part.projected.extents)
        self._own_visible = visible = joined(lambda part: part.projected.visible)
        self._own_roots = joined(lambda part: part.projected.roots)
        self._own_thermal: Tensor | None = None
        if first.thermal_opacities is not None:
            self._own_thermal = joined(lambda part: cast("Tensor", part.thermal_opacities))
        self._parts, self._sizes = parts, sizes
        self._inputs, self._harmonics, self._cameras = first._inputs, first._harmonics, first._cameras

        capacity = active_pair_capacity()
        room = None if capacity is None else capacity.room_for_rows()
        route = (
            route_of_seen(visible, counts)
            if room is None
            else route_in_room(visible, counts, min(room, most_gaussians))
        )
        if capacity is not None:
            capacity.note_rows(visible.sum(dim=1).amax())
            if cameras == 0:
                capacity.note(visible.new_zeros(1, dtype=torch.int64))  # it has no pairs, and is a call all the same
        self.settings = replace(
            first.settings,
            width=width,
            height=height,
            num_gaussians=route.seen,
            num_cameras=cameras,
            num_images=cameras,
        )
        self.images_shape = (cameras,)
        differentiable = [self._own_means2d, self._own_depths, self._own_roots, self._own_opacities]
        if self._own_thermal is not None:
            differentiable.append(self._own_thermal)
        of_parts = zip(*(part.features for part in parts), strict=True)
        features = [flat[0] if len(flat) == 1 else torch.cat(flat) for flat in of_parts]
        carried = [self._own_extents]
        rows = [_rows(tensor, num_gaussians * len(sizes)) for tensor in (*differentiable, *features, *carried)]
        packed_roots = _rows(joined(lambda part: part.projected.packed_roots), num_gaussians * len(sizes))
        self._absolute = AbsoluteGradients(self._own_means2d)
        self.shown_means2d = self._absolute.received
        wider = {2: packed_roots}  # of the roots
        *received, packed_roots = Exchange.apply(route, self._absolute, len(carried), wider, *rows)
        for part in parts:
            part.features = []  # they were sent, and nothing reads them here again
        shape = (cameras, route.seen)
        means2d, depths, roots, opacities = received[:4]
        self.thermal_opacities = None if self._own_thermal is None else received[4].reshape(shape)
        self.features = received[len(differentiable) : -len(carried)]
        extents = received[-1].reshape(*shape, 2)
        self.means2d, self.depths = means2d.reshape(*shape, 2), depths.reshape(shape)
        self.opacities = opacities.reshape(shape)
        self.projected = ProjectedTensors(
            means2d=self.means2d,
            depths=self.depths,
            roots=roots.reshape(*shape, 3),
            compensations=None,  # the opacities have them
            visible=extents[..., 0] > 0,  # what arrived; the rest of the room is zeros
            extents=extents,
            packed_roots=packed_roots.reshape(*shape, 4),
        )
        self._arrays = self.projected.arrays()

    def blend(
        self,
        features: Tensor,
        absgrad: bool,
        *,
        rest: Tensor | None = None,
        thermal_channels: int = 0,
        thermal_opacity: bool = False,
    ) -> BlendedTensors:
        """As ``ProjectedScene.blend``; without a camera of its own a rank gets images of nothing, [0, H, W, ...].

        Their gradients still must travel: to zero rows here, and to this rank's Gaussians from the other ranks.
        """
        self._absolute.wanted = self._absolute.wanted or absgrad
        if self.settings.num_cameras > 0:
            return super().blend(
                features, absgrad, rest=rest, thermal_channels=thermal_channels, thermal_opacity=thermal_opacity
            )
        last, thermal = features if rest is None else rest, self.thermal_opacities
        second = thermal if thermal_channels > 0 else None
        first = thermal if thermal_opacity and thermal is not None else self.opacities
        return BlendedTensors(
            render=self._no_images(features, features.shape[1]),
            rest=None if rest is None else self._no_images(rest, rest.shape[1]),
            alphas=self._no_images(first, 1),
            transmittance=self._no_images(first, 1),
            thermal_render=None if second is None else self._no_images(last[:, -thermal_channels:], thermal_channels),
            thermal_alphas=None if second is None else self._no_images(second, 1),
        )

    def blend_in_chunks(
        self, features: Tensor, chunk: int, absgrad: bool, *, thermal_opacity: bool = False
    ) -> BlendedTensors:
        """As ``ProjectedScene.blend_in_chunks``."""
        if self.settings.num_cameras > 0:
            return super().blend_in_chunks(features, chunk, absgrad, thermal_opacity=thermal_opacity)
        return self.blend(features, absgrad, thermal_opacity=thermal_opacity)

    def _no_images(self, values: Tensor, channels: int) -> Tensor:
        """Images [0, H, W, channels] that depend on values, of which there are none."""
        return values.reshape(0, 1, 1, channels).expand(0, self.settings.height, self.settings.width, channels)

    def info(self) -> RasterizationInfo:
        """gsplat's ``meta`` of a distributed call.

        Of this rank's Gaussians before the cameras of all ranks, in the order of ranks: means2d [C_world, N, 2], radii,
        depths, conics, opacities, with ``n_cameras`` C_world and ``sizes`` [(width, height)] of every camera. Of what
        this rank blended, its own C cameras: the sorted pairs and their tiles; nothing where C is 0.
        """
        visible, roots, parts = self._own_visible, self._own_roots, self._parts
        own: dict[str, Any] = {
            "visible": visible,
            "opacities": self._own_opacities,
            "n_cameras": len(self._sizes),
            "sizes": list(self._sizes),
        }
        if self._own_thermal is not None:
            own["thermal_opacities"] = self._own_thermal
        if self.settings.num_cameras > 0:
            info = super().info()
            info.update(own)
        else:
            info = RasterizationInfo(self._no_pairs() | own, {})
        for key, compute in entries_of_seen(self._own_means2d, self._own_depths, self._own_extents, visible).items():
            info.compute_later(key, compute)
        info.compute_later("conics", lambda: conics(roots, visible))
        info.compute_later("num_nonfinite", lambda: max(part.num_nonfinite() for part in parts))
        return info

    def _no_pairs(self) -> dict[str, Any]:
        settings = self.settings
        tiles_x, tiles_y = -(-settings.width // self.tile_size), -(-settings.height // self.tile_size)
        none = self._own_visible.new_zeros(0, dtype=torch.int32)
        return {
            "batch_ids": None,
            "camera_ids": None,
            "gaussian_ids": None,
            "tile_width": tiles_x,
            "tile_height": tiles_y,
            "flatten_ids": none,
            "isect_ids": none.long(),
            "isect_offsets": none.reshape(0, 1, 1).expand(0, tiles_y, tiles_x),
            "tiles_per_gauss": none.reshape(0, 0),
            "width": settings.width,
            "height": settings.height,
            "tile_size": self.tile_size,
            "n_batches": 1,
        }


def _rows(tensor: Tensor, count: int) -> Tensor:
    """One row for each Gaussian before each camera; without Gaussians too."""
    width = tensor.numel() // count if count > 0 else _width_of_empty(tensor)
    return tensor.reshape(count, width)


def _width_of_empty(tensor: Tensor) -> int:
    """Numbers of a row of a tensor [C, 0] or [C, 0, X], or of features [0, X]."""
    return tensor.shape[-1] if tensor.dim() == 3 or (tensor.dim() == 2 and tensor.shape[-1] > 0) else 1
