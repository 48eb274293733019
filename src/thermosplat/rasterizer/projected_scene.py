"""A scene projected once, and the tensors everything blended from it shares. Flat index: image · N + Gaussian."""

import functools
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from typing import NamedTuple, cast

import torch
from torch import Tensor

from thermosplat.rasterizer.binning import TileLists, tile_lists
from thermosplat.rasterizer.blending import Blend, BlendedTensors, BlendInputs
from thermosplat.rasterizer.distances import distances
from thermosplat.rasterizer.info import InfoTensors, RasterizationInfo, TiledSize, num_nonfinite, rasterization_info
from thermosplat.rasterizer.lenses import Lenses
from thermosplat.rasterizer.pair_capacity import active_pair_capacity
from thermosplat.rasterizer.projection import Harmonics, Project, ProjectedTensors, ProjectInputs
from thermosplat.torch_bridge.arrays import kinds_of, view
from warp_kernels.color.color_step import ColorSettings
from warp_kernels.projection.projection import ProjectionSettings


class BlendedValues(NamedTuple):
    """Colours or features, which are blended."""

    values: Tensor | tuple[Tensor, Tensor]
    """[..., (C,) N, X]; with ``sh_degree`` [..., (C,) N, K, 3], or the first coefficient and the others apart."""
    sh_degree: int | None
    per_camera: bool
    clamped: bool = True
    """Sums of spherical harmonics below 0 become 0."""


_watcher: "ContextVar[Callable[[ProjectedScene], None] | None]" = ContextVar("watcher of scenes", default=None)


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


class ProjectedScene:
    """Gaussians projected to the cameras of their scenes; arguments are checked by the caller.

    Args:
        means: [..., N, 3].
        quats: [..., N, 4], or None with ``covars``.
        scales: [..., N, 3], or None with ``covars``.
        covars: [..., N, 3, 3] in place of ``quats`` and ``scales``, or None.
        opacities: [..., N].
        thermal_opacities: [..., N], or None where there is one opacity.
        viewmats: [..., C, 4, 4].
        Ks: [..., C, 3, 3], px.
        settings: image size, counts, planes and mode.
        tile_size: edge of a tile [px].
        drawn: what is to be blended, of which ``features`` holds the final values, each flat [images · N, X].
        deterministic: sum gradients in the same order every time, on CUDA at a cost (on the CPU that is always so).
        global_z_order: sort by the camera's z axis; else by the distance from its centre, which ``depths`` then are.
        lenses: what cameras see through, and how they are read out; None: nothing, and all at once.
    """

    def __init__(
        self,
        means: Tensor,
        quats: Tensor | None,
        scales: Tensor | None,
        covars: Tensor | None,
        opacities: Tensor,
        thermal_opacities: Tensor | None,
        viewmats: Tensor,
        Ks: Tensor,
        settings: ProjectionSettings,
        tile_size: int,
        *,
        drawn: Sequence[BlendedValues] = (),
        deterministic: bool = False,
        global_z_order: bool = True,
        lenses: Lenses | None = None,
    ) -> None:
        self.tile_size = tile_size
        self.deterministic = deterministic
        self._turns = threading.Lock()
        self.settings = settings
        self.images_shape = (*means.shape[:-2], settings.num_cameras)
        means = means.contiguous()
        upper = None
        if covars is not None or quats is None or scales is None:
            quats = scales = None
            if covars is not None:
                upper = torch.cat([covars[..., 0, :], covars[..., 1, 1:], covars[..., 2, 2:]], -1)
        else:
            quats, scales = quats.contiguous(), scales.contiguous()
        shapes = ((means, 3), (quats, 4), (scales, 3), (upper, 6))
        # and what is drawn as it is; detached when they are counted
        self._inputs = [(tensor, width) for tensor, width in shapes if tensor is not None]
        self._cameras = [viewmats, Ks]
        if lenses is not None:
            self._cameras += [tensor for tensor in lenses[1:] if tensor is not None]
            viewmats = lenses.viewmats
        harmonics = [_harmonics(one, settings) for one in drawn]
        self._harmonics = [one for one in harmonics if one is not None]
        opacities = opacities.contiguous()
        bound = second = view(opacities, kinds_of(means.dtype).scalar)
        if thermal_opacities is not None:
            thermal_opacities = thermal_opacities.contiguous()
            second = view(thermal_opacities, bound.dtype, *bound.shape)
        means2d, depths, roots, compensations, *evaluated, others, self._arrays = Project.apply(
            means,
            quats,
            scales,
            upper,
            viewmats.contiguous(),
            Ks.contiguous(),
            None if lenses is None else lenses.coefficients.contiguous(),
            None if lenses is None or lenses.motions is None else lenses.motions.contiguous(),
            ProjectInputs(
                bound,
                second,
                settings,
                tuple([one.settings for one in self._harmonics]),
                self.images_shape,
                self._turns,
                torch.is_grad_enabled(),
                None if lenses is None else lenses.settings,
            ),
            *[coefficients for one in self._harmonics for coefficients in one[:2]],
        )
        self.projected = ProjectedTensors(means2d, depths, roots, compensations, *others)
        self.features = [
            self._per_image(one) if sh is None else evaluated.pop(0) for one, sh in zip(drawn, harmonics, strict=True)
        ]
        # The tensors users see lie on the path of the gradient, so that retain_grad() on them works.
        self.means2d, self.depths = self.projected.means2d, self.projected.depths
        self.shown_means2d = self.means2d
        if not global_z_order:
            self.depths = distances(means, viewmats, self.projected.visible)
            self._arrays = replace(self._arrays, depths=view(self.depths, kinds_of(means.dtype).scalar))
        self.opacities = self._per_image_opacities(opacities)
        self.thermal_opacities = None if thermal_opacities is None else self._per_image_opacities(thermal_opacities)
        self._lists: TileLists | None = None
        watcher = _watcher.get()
        if watcher is not None:
            watcher(self)

    def _per_image_opacities(self, opacities: Tensor) -> Tensor:
        self._inputs.append((opacities, 1))
        per_image = opacities.unsqueeze(-2)
        if self.settings.num_cameras != 1:
            per_image = per_image.expand(*self.images_shape, -1)
        if self.projected.compensations is not None:
            per_image = per_image * self.projected.compensations
        return per_image.contiguous()

    def _per_image(self, drawn: BlendedValues) -> Tensor:
        """Final values repeated for each camera where they are shared."""
        values = cast("Tensor", drawn.values)  # only coefficients come in pairs
        self._inputs.append((values, values.shape[-1]))
        if not drawn.per_camera and self.settings.num_cameras != 1:
            values = values.unsqueeze(-3).expand(*self.images_shape, *values.shape[-2:])
        return _flat(values)

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
        opacities = self.opacities
        if thermal_opacity and self.thermal_opacities is not None:
            opacities = self.thermal_opacities
        second = self.thermal_opacities if thermal_channels > 0 else None
        inputs = BlendInputs(
            self._arrays,
            self.projected.extents,
            self.projected.packed_roots,
            self._bin(features, rest),
            self.settings,
            self.images_shape,
            thermal_channels,
            self.shown_means2d if absgrad else None,
            self._turns,
            torch.is_grad_enabled(),
        )
        tensors = (self.means2d, self.projected.roots, opacities, second, features, rest)
        return BlendedTensors(*Blend.apply(*tensors, inputs))

    def blend_in_chunks(
        self, features: Tensor, chunk: int, absgrad: bool, *, thermal_opacity: bool = False
    ) -> BlendedTensors:
        """Blends flat features of any width, ``chunk`` channels a traversal, at one opacity.

        The opacity is the first traversal's.
        """
        if features.shape[-1] <= chunk:
            return self.blend(features, absgrad, thermal_opacity=thermal_opacity)
        self._bin(features)  # all of them are checked for being finite, not only the first chunk
        parts = [
            self.blend(part.contiguous(), absgrad, thermal_opacity=thermal_opacity)
            for part in features.split(chunk, dim=-1)
        ]
        return parts[0]._replace(render=torch.cat([part.render for part in parts], -1))

    def binned(self, features: Tensor) -> TileLists:
        """The lists of Gaussians in tiles, for a blending of one's own; made once.

        Args:
            features: [images · N, X]; Gaussians of which they are not finite are left out.
        """
        return self._bin(features)

    def _bin(self, features: Tensor, rest: Tensor | None = None) -> TileLists:
        """The lists of Gaussians, made once; the features of the first call are checked for being finite."""
        if self._lists is None:
            capacity = active_pair_capacity()
            self._lists = tile_lists(
                self._arrays,
                self.opacities,
                self.opacities if self.thermal_opacities is None else self.thermal_opacities,
                features,
                self.settings,
                self.tile_size,
                rest,
                capacity.room() if capacity is not None else None,
                deterministic=self.deterministic,
                note=None if capacity is None else capacity.note,
            )
        return self._lists

    def num_nonfinite(self) -> int:
        """Gaussians that something not finite makes invisible; see ``info.num_nonfinite``."""
        scenes = math.prod(self.images_shape[:-1])
        inputs = [*self._inputs, *_used(self._harmonics)]
        return num_nonfinite(inputs, self._cameras, scenes, self.settings.num_gaussians)

    def info(self) -> RasterizationInfo:
        """gsplat's ``meta`` dictionary, once something has been blended."""
        scenes, num_gaussians = math.prod(self.images_shape[:-1]), self.settings.num_gaussians
        inputs, harmonics, cameras = self._inputs, self._harmonics, self._cameras
        # What is computed later holds the tensors that it reads and not this scene.
        return rasterization_info(
            self.shown(),
            self.size,
            lambda: num_nonfinite([*inputs, *_used(harmonics)], cameras, scenes, num_gaussians),
        )

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


_color_settings = functools.lru_cache(maxsize=256)(ColorSettings)


def _harmonics(drawn: BlendedValues, settings: ProjectionSettings) -> Harmonics | None:
    """Coefficients as ``Project`` takes them; None of final values."""
    if drawn.sh_degree is None:
        return None
    sh0, shN = drawn.values if isinstance(drawn.values, tuple) else (drawn.values, None)
    shN = None if shN is None or shN.shape[-2] == 0 else shN.contiguous()
    counts = (settings.num_gaussians, settings.num_cameras)
    how = _color_settings(drawn.sh_degree, *counts, drawn.per_camera, clamped=drawn.clamped)
    return Harmonics(sh0.contiguous(), shN, how)


def _used(harmonics: Sequence[Harmonics]) -> Iterator[tuple[Tensor, int]]:
    """The coefficients of active degrees, each tensor with its number of values per Gaussian."""
    for sh0, shN, settings in harmonics:
        active = (settings.degree + 1) ** 2
        first = min(active, sh0.shape[-2])
        yield sh0[..., :first, :], 3 * first
        if shN is not None:
            yield shN[..., : active - 1, :], 3 * (active - 1)


def _flat(values: Tensor) -> Tensor:
    """Values of all images (or scenes) side by side, [images · N, X]."""
    if values.dim() != 2:
        values = values.reshape(-1, values.shape[-1])
    return values.contiguous()
