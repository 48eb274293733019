"""A scene whose Gaussians are divided over ranks, as one of them blends it for its own cameras.

Every rank projects its Gaussians to the cameras of all; ``rasterizer.exchange`` brings what a rank's cameras see to
it, where it is binned and blended like any other scene.
"""

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, cast

import torch
import torch.distributed as dist
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.blending_autograd import BlendedTensors
from thermosplat.rasterizer.call_inputs import Cameras
from thermosplat.rasterizer.cameras_of_ranks import CameraKind, cameras_of_ranks
from thermosplat.rasterizer.exchange import AbsoluteGradients, Exchange
from thermosplat.rasterizer.info import Entries, RasterizationInfo, clear_unseen, conics, radii_of
from thermosplat.rasterizer.lenses import Lenses
from thermosplat.rasterizer.pair_capacity import active_pair_capacity
from thermosplat.rasterizer.projected_scene import ProjectedScene
from thermosplat.rasterizer.projection_autograd import ProjectedTensors
from thermosplat.rasterizer.row_routes import route_in_room, route_of_seen

MOST_ROWS = 2**31
"""Projected Gaussians are numbered with 32 bits."""

MakeScene = Callable[[Cameras, Lenses | None, slice], ProjectedScene]
"""Projects this rank's Gaussians to cameras of one kind: their lenses, and which of all they are."""


def scene_among_ranks(
    make: MakeScene, own: Cameras, kind: CameraKind, lenses: Lenses | None, num_gaussians: int
) -> ProjectedScene:
    """What this rank's cameras see of the Gaussians of all ranks.

    Args:
        own: This rank's cameras, [C, 4, 4] and [C, 3, 3], checked; there may be none.
        kind: What they have in common; other ranks may have others.

    Raises:
        UserError: No rank has a camera.
    """
    cameras = cameras_of_ranks(own.viewmats, own.Ks, kind, lenses, num_gaussians)
    parts = [make(own._replace(**alike), through, which) for alike, through, which in cameras.by_kind()]
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
        settings = replace(
            first.settings,
            width=width,
            height=height,
            num_gaussians=route.seen,
            num_cameras=cameras,
            num_images=cameras,
        )
        differentiable = [self._own_means2d, self._own_depths, self._own_roots, self._own_opacities]
        if self._own_thermal is not None:
            differentiable.append(self._own_thermal)
        of_parts = zip(*(part.features for part in parts), strict=True)
        features = [flat[0] if len(flat) == 1 else torch.cat(flat) for flat in of_parts]
        carried = [self._own_extents]
        rows = [_rows(tensor, num_gaussians * len(sizes)) for tensor in (*differentiable, *features, *carried)]
        packed_roots = _rows(joined(lambda part: part.projected.packed_roots), num_gaussians * len(sizes))
        self._absolute = AbsoluteGradients(self._own_means2d)
        wider = {2: packed_roots}  # of the roots
        *received, packed_roots = Exchange.apply(route, self._absolute, len(carried), wider, *rows)
        for part in parts:
            part.features = []  # they were sent, and nothing reads them here again
        shape = (cameras, route.seen)
        means2d, depths, roots, opacities = received[:4]
        extents = received[-1].reshape(*shape, 2)
        projected = ProjectedTensors(
            means2d=means2d.reshape(*shape, 2),
            depths=depths.reshape(shape),
            roots=roots.reshape(*shape, 3),
            compensations=None,  # the opacities have them
            visible=extents[..., 0] > 0,  # what arrived; the rest of the room is zeros
            extents=extents,
            packed_roots=packed_roots.reshape(*shape, 4),
        )
        super().__init__(
            projected,
            projected.arrays(),
            opacities.reshape(shape),
            None if self._own_thermal is None else received[4].reshape(shape),
            received[len(differentiable) : -len(carried)],
            settings,
            (cameras,),
            first.tile_size,
            threading.Lock(),
            deterministic=first.deterministic,
            num_nonfinite=lambda: max(part.num_nonfinite() for part in parts),
        )
        self.shown_means2d = self._absolute.received

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
        visible, thermal = self._own_visible, self._own_thermal
        own: dict[str, Callable[[], Any]] = {
            "visible": lambda: visible,
            "opacities": partial(_given, self._own_opacities),
            "n_cameras": partial(_given, len(self._sizes)),
            "sizes": partial(_given, list(self._sizes)),
            "means2d": partial(clear_unseen, self._own_means2d, visible),
            "depths": partial(clear_unseen, self._own_depths, visible),
            "radii": partial(radii_of, self._own_extents, visible),
            "conics": partial(conics, self._own_roots, visible),
            "num_nonfinite": self.num_nonfinite,
        }
        if thermal is not None:
            own["thermal_opacities"] = lambda: thermal
        blended = super().info().entries if self.settings.num_cameras > 0 else None
        pairs = {} if blended is not None else {key: partial(_given, one) for key, one in self._no_pairs().items()}
        return RasterizationInfo(EntriesOfRank(pairs | own, blended))

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


@dataclass(frozen=True)
class EntriesOfRank:
    """The entries of a distributed call."""

    own: Mapping[str, Callable[[], Any]]
    """By key, what makes the entries of this rank's Gaussians."""
    blended: Entries | None
    """Of what this rank blended; None: nothing."""
    are_of_ranks: ClassVar[bool] = True

    @property
    def keys(self) -> Iterable[str]:
        """Of the entries."""
        return self.own.keys() | (self.blended.keys if self.blended is not None else ())

    def made(self, key: str) -> Any:
        """The value of one of the keys."""
        if self.blended is None or key in self.own:
            return self.own[key]()
        return self.blended.made(key)


def _given(value: Any) -> Any:
    return value


def _rows(tensor: Tensor, count: int) -> Tensor:
    """One row for each Gaussian before each camera; without Gaussians too."""
    width = tensor.numel() // count if count > 0 else _width_of_empty(tensor)
    return tensor.reshape(count, width)


def _width_of_empty(tensor: Tensor) -> int:
    """Numbers of a row of a tensor [C, 0] or [C, 0, X], or of features [0, X]."""
    return tensor.shape[-1] if tensor.dim() == 3 or (tensor.dim() == 2 and tensor.shape[-1] > 0) else 1
