"""A scene projected once, and the tensors everything blended from it shares. Flat index: image · N + Gaussian."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial

import torch
from torch import Tensor
from torch.autograd import forward_ad

from thermosplat.errors import UserError
from thermosplat.rasterizer.blending_autograd import Blend, BlendedTensors, BlendInputs, TileLists
from thermosplat.rasterizer.info import InfoTensors, RasterizationInfo, SceneEntries, TiledSize
from thermosplat.rasterizer.pair_capacity import active_pair_capacity
from thermosplat.rasterizer.projection_autograd import ProjectedTensors
from thermosplat.torch_bridge.arrays import kinds_of
from thermosplat.torch_bridge.streams import joined_capture, on_torch_stream
from warp_kernels.binning import binning_step
from warp_kernels.binning.tile_bins import Room
from warp_kernels.machinery.array_views import ArrayView
from warp_kernels.projection.projection import ProjectedArrays, ProjectionSettings

_watcher: "ContextVar[Callable[[ProjectedScene], None] | None]" = ContextVar("watcher of scenes", default=None)

_CAPTURED_WITHOUT_ROOM = (
    "A CUDA graph cannot capture a rasterization that reads its number of (Gaussian, tile) pairs back.",
    "Give it room for them beforehand with thermosplat.PairCapacity, whose documentation has an example.",
)
_blend_unrecorded = partial(Blend.forward, None)


@contextmanager
def scenes_told_to(watcher: "Callable[[ProjectedScene], None]") -> Iterator[None]:
    """Tells of every scene that this thread projects, for code that needs what lies between projection and blending.

    Args:
        watcher: Called with each scene once it is projected.
    """
    outer = _watcher.set(watcher)
    try:
        yield
    finally:
        _watcher.reset(outer)


def none() -> int:
    """No Gaussians, where nobody counts them."""
    return 0


class ProjectedScene:
    """Gaussians projected to the cameras of their scenes; ``scene_of_call`` makes it of a call.

    Args:
        projected: what ``Project`` returned, or what stands for it.
        arrays: of the same memory.
        opacities: [..., C, N] as they are blended, contiguous.
        thermal_opacities: likewise; None where there is one opacity.
        features: final values of what is to be blended, each flat [images · N, X].
        settings: image size, counts, planes and mode.
        images_shape: [..., C].
        tile_size: edge of a tile [px].
        turns: held by whoever differentiates the scene; see ``once_in_turns``.
        deterministic: sum gradients in the same order every time, on CUDA at a cost (on the CPU that is always so).
        num_nonfinite: counts the Gaussians that something not finite makes invisible; see ``info.num_nonfinite``.
        lists: of Gaussians in tiles; None: they are made when something is blended.
    """

    def __init__(
        self,
        projected: ProjectedTensors,
        arrays: ProjectedArrays,
        opacities: Tensor,
        thermal_opacities: Tensor | None,
        features: list[Tensor],
        settings: ProjectionSettings,
        images_shape: tuple[int, ...],
        tile_size: int,
        turns: threading.Lock,
        *,
        deterministic: bool = False,
        num_nonfinite: Callable[[], int] = none,
        lists: TileLists | None = None,
    ) -> None:
        self.projected, self._arrays = projected, arrays
        # The tensors users see lie on the path of the gradient, so that retain_grad() on them works.
        self.means2d, self.depths = projected.means2d, projected.depths
        self.shown_means2d = self.means2d
        self.opacities, self.thermal_opacities, self.features = opacities, thermal_opacities, features
        scalar, rows, device = kinds_of(opacities.dtype).scalar, arrays.means2d.shape, arrays.means2d.device
        self._bound = self._thermal_bound = ArrayView(opacities.data_ptr(), rows, scalar, device)
        if thermal_opacities is not None:
            self._thermal_bound = ArrayView(thermal_opacities.data_ptr(), rows, scalar, device)
        self.settings, self.images_shape, self.tile_size = settings, images_shape, tile_size
        self.deterministic, self.num_nonfinite = deterministic, num_nonfinite
        self._turns, self._lists = turns, lists
        watcher = _watcher.get()
        if watcher is not None:
            watcher(self)

    def blend(
        self,
        features: Tensor,
        absgrad: bool,
        *,
        rest: Tensor | None = None,
        thermal_channels: int = 0,
        thermal_opacity: bool = False,
    ) -> BlendedTensors:
        """Blends flat features; with ``thermal_channels``, the last of them a second time at the thermal opacity.

        ``rest``: flat features to blend beside the others, to an image of their own.
        """
        opacities, bound = self.opacities, self._bound
        if thermal_opacity and self.thermal_opacities is not None:
            opacities, bound = self.thermal_opacities, self._thermal_bound
        second = self.thermal_opacities if thermal_channels > 0 else None
        inputs = BlendInputs(
            self._arrays,
            self.projected.extents,
            self.projected.packed_roots,
            bound,
            bound if second is None else self._thermal_bound,
            self.binned(features, rest),
            self.settings,
            self.images_shape,
            thermal_channels,
            self.shown_means2d if absgrad else None,
            self._turns,
        )
        recorded = torch.is_grad_enabled() or forward_ad._current_level >= 0
        blended = (Blend.apply if recorded else _blend_unrecorded)(
            self.means2d, self.projected.roots, opacities, second, features, rest, inputs
        )
        return BlendedTensors(*blended)

    def blend_in_chunks(
        self, features: Tensor, chunk: int, absgrad: bool, *, thermal_opacity: bool = False
    ) -> BlendedTensors:
        """Blends flat features of any width, ``chunk`` channels a traversal, at one opacity.

        The opacity is the first traversal's.
        """
        if features.shape[-1] <= chunk:
            return self.blend(features, absgrad, thermal_opacity=thermal_opacity)
        self.binned(features)  # all of them are checked for being finite, not only the first chunk
        parts = [
            self.blend(part.contiguous(), absgrad, thermal_opacity=thermal_opacity)
            for part in features.split(chunk, dim=-1)
        ]
        return parts[0]._replace(render=torch.cat([part.render for part in parts], -1))

    def binned(self, features: Tensor, rest: Tensor | None = None) -> TileLists:
        """The lists of Gaussians in tiles, made once.

        Args:
            features: [images · N, X]; Gaussians of which they are not finite are left out. Those of the first call
                count.
            rest: As ``features``, further ones.
        """
        if self._lists is None:
            capacity = active_pair_capacity()
            self._lists = tile_lists(
                self._arrays,
                self._bound,
                self._thermal_bound,
                features,
                self.settings,
                self.tile_size,
                rest,
                capacity.room() if capacity is not None else None,
                deterministic=self.deterministic,
                note=None if capacity is None else capacity.note,
            )
        return self._lists

    def info(self) -> RasterizationInfo:
        """gsplat's ``meta`` dictionary, once something has been blended."""
        # What is made later holds the tensors that it reads and not this scene.
        return RasterizationInfo(SceneEntries(self.shown(), self.size, self.num_nonfinite))

    @property
    def size(self) -> TiledSize:
        """Of the images, once something has been blended."""
        bins = self._made_lists().bins
        return TiledSize(self.settings.width, self.settings.height, bins.tile_size, bins.tiles_x, bins.tiles_y)

    def shown(self) -> InfoTensors:
        """What ``info`` is made of, once something has been blended."""
        lists = self._made_lists().tensors
        return InfoTensors(
            self.means2d,
            self.projected.visible,
            self.projected.extents,
            self.depths,
            self.projected.roots,
            self.opacities,
            self.thermal_opacities,
            lists["gaussian_ids"],
            lists["tile_offsets"],
            lists["tiles_per_gaussian"],
        )

    def _made_lists(self) -> TileLists:
        if self._lists is None:
            raise RuntimeError("info() comes after blend().")
        return self._lists


def tile_lists(
    projected: ProjectedArrays,
    opacities: ArrayView,
    thermal_opacities: ArrayView,
    features: Tensor,
    settings: ProjectionSettings,
    tile_size: int,
    rest: Tensor | None = None,
    room: Room | None = None,
    *,
    deterministic: bool = False,
    note: Callable[[Tensor], None] | None = None,
) -> TileLists:
    """Lists the Gaussians of each tile.

    Args:
        projected: what ``Project`` returned; Gaussians with non-finite features become invisible, in place.
        opacities: [images · N], compensation included.
        thermal_opacities: [images · N]; the same array where there is one opacity.
        features: [images · N, D].
        tile_size: edge of a tile [px].
        rest: [images · N, D'], channels that lie apart from those; None: there are no others.
        room: of the lists; None: the number of pairs is read back from the device.
        deterministic: number the pairs, so that the adjoint sums in the same order every time; always on the CPU.
        note: told how many pairs there are (``PairCapacity.note``) before they are listed.

    Raises:
        UserError: if a CUDA graph is captured without a ``room``, or there are too many pairs to number.
    """
    scalar, where = opacities.dtype, features.device
    flat = ArrayView(features.data_ptr(), tuple(features.shape), scalar, opacities.device)
    others = None if rest is None else ArrayView(rest.data_ptr(), tuple(rest.shape), scalar, opacities.device)
    drawn = (projected, opacities, thermal_opacities)
    with on_torch_stream(where) as device:
        try:
            with joined_capture(where) as captured:
                if captured and room is None:
                    raise UserError(*_CAPTURED_WITHOUT_ROOM)
                nearest_first = binning_step.sort_gaussians(*drawn, flat, settings, tile_size, rest=others, room=room)
            if note is not None:  # outside of both: whoever is told may end a capture here, and begin the next
                totals, ends = nearest_first.totals, nearest_first.pair_ends
                note(ends.owner[-1:] if totals is None else totals.owner[-1])
            by_slot = deterministic or not device.is_cuda
            with joined_capture(where):
                bins = binning_step.list_pairs(*drawn, nearest_first, by_slot=by_slot, room=room)
        except binning_step.TooManyPairsError as error:
            raise UserError(str(error), "Render fewer cameras per call, a smaller image, or smaller scales.") from error
    tensors: dict[str, Tensor] = {}
    for name, array in vars(bins).items():
        if type(array) is ArrayView:
            tensors[name], array.owner = array.owner, None
    return TileLists(bins, tensors)
