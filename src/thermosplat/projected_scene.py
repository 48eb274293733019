"""A scene projected once, and the tensors everything blended from it shares. Flat index: image · N + Gaussian."""

import math

import torch
from torch import Tensor

from thermosplat.pair_capacity import active_pair_capacity
from thermosplat.rasterization_info import RasterizationInfo, conics, isect_ids, num_nonfinite
from thermosplat.warp_bridge import Blend, BlendInputs, Project, ProjectedTensors, ShColors, bin_tiles, to_torch
from warp_kernels.projection import ProjectedArrays, ProjectionSettings
from warp_kernels.tile_binning import TileBins


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
        deterministic: sum gradients in the same order every time, on CUDA at a cost (on the CPU that is always so).
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
        deterministic: bool = False,
    ) -> None:
        self.tile_size = tile_size
        self.deterministic = deterministic
        self.settings = settings
        self.images_shape = (*means.shape[:-2], settings.num_cameras)
        self.means = means.reshape(-1, 3).contiguous()
        self.viewmats = viewmats.reshape(-1, 4, 4).contiguous()
        if covars is not None:
            upper = covars[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].reshape(-1, 6).contiguous()
        else:
            upper = None
        if covars is not None or quats is None or scales is None:
            quats, scales = means.new_empty(0, 4), means.new_empty(0, 3)
        bound = _flat(opacities.detach())
        shape = [(quats.detach(), 4), (scales.detach(), 3)] if upper is None else [(upper.detach(), 6)]
        self._inputs = [(self.means.detach(), 3), *shape]  # and what per_image and colors are given
        self.projected = ProjectedTensors(
            *Project.apply(
                self.means,
                quats.reshape(-1, 4).contiguous(),
                scales.reshape(-1, 3).contiguous(),
                upper,
                bound,
                bound if thermal_opacities is None else _flat(thermal_opacities.detach()),
                self.viewmats,
                Ks.reshape(-1, 3, 3).contiguous(),
                settings,
            )
        )
        # The tensors users see lie on the path of the gradient, so that retain_grad() on them works.
        self.means2d = self.projected.means2d.reshape(*self.images_shape, -1, 2)
        self.depths = self.projected.depths.reshape(*self.images_shape, -1)
        self.opacities = self._per_image_opacities(opacities)
        self.thermal_opacities = None if thermal_opacities is None else self._per_image_opacities(thermal_opacities)
        self._binned: tuple[ProjectedArrays, TileBins] | None = None

    def _per_image_opacities(self, opacities: Tensor) -> Tensor:
        per_image = self.per_image(opacities.unsqueeze(-1), per_camera=False).squeeze(-1)
        if self.settings.antialiased:
            per_image = per_image * self.projected.compensations
        return per_image.reshape(*self.images_shape, -1)

    def per_image(self, values: Tensor, *, per_camera: bool) -> Tensor:
        """Values [..., (C,) N, X] repeated for each camera where they are shared, flat [images · N, X]."""
        self._inputs.append((values.detach(), values.shape[-1]))
        if not per_camera and self.settings.num_cameras != 1:
            values = values.unsqueeze(-3).expand(*self.images_shape, *values.shape[-2:])
        return values.reshape(-1, values.shape[-1]).contiguous()

    def colors(
        self, colors: Tensor, sh_degree: int | None, *, per_camera: bool, higher_degrees: Tensor | None = None
    ) -> Tensor:
        """Colours, or with ``sh_degree`` their coefficients in the view directions, flat [images · N, D].

        ``higher_degrees``: coefficients above degree 0, where ``colors`` holds those of degree 0 alone.
        """
        if sh_degree is None:
            return self.per_image(colors, per_camera=per_camera)
        active = (sh_degree + 1) ** 2
        self._note(colors[..., :active, :])
        if higher_degrees is not None:
            self._note(higher_degrees[..., : active - 1, :])
            rest = higher_degrees.shape[-2:]
            higher_degrees = higher_degrees.reshape(-1, *rest).contiguous() if rest[0] > 0 else None
        # inv_ex does not synchronise with the device, as inverse() does. float64, because directions are differences.
        viewmats = self.viewmats.to(torch.float64, copy=True)
        if viewmats.requires_grad:
            viewmats.register_hook(_held_by_float32)
        camera_positions = torch.linalg.inv_ex(viewmats)[0][:, :3, 3].contiguous()
        return ShColors.apply(
            self.means,
            camera_positions,
            colors.reshape(-1, *colors.shape[-2:]).contiguous(),
            higher_degrees,
            self.projected.radii,
            sh_degree,
            per_camera,
            self.settings.num_gaussians,
            self.settings.num_cameras,
        )

    def _note(self, coefficients: Tensor) -> None:
        """Remembers coefficients [..., N, K, 3] as an input whose numbers should be finite."""
        self._inputs.append((coefficients.detach(), coefficients.shape[-2] * 3))

    def blend(
        self, features: Tensor, thermal_channels: int, absgrad: bool, *, thermal_opacity: bool = False
    ) -> list[Tensor]:
        """Blends flat features; with ``thermal_channels``, the last of them a second time at the thermal opacity.

        Returns images [..., C, H, W, channels] and transmittances [..., C, H, W, 1], alternating, a pair an opacity.
        """
        opacities = self.opacities
        if thermal_opacity and self.thermal_opacities is not None:
            opacities = self.thermal_opacities
        second = self.thermal_opacities if thermal_channels > 0 else None
        results = Blend.apply(
            self.means2d.reshape(-1, 2),
            self.projected.roots,
            _flat(opacities),
            None if second is None else _flat(second),
            features,
            BlendInputs(*self._bin(features), self.settings, thermal_channels, absgrad, self.means2d),
        )
        shape = (*self.images_shape, self.settings.height, self.settings.width, -1)
        return [image.reshape(shape) for image in results]

    def blend_in_chunks(
        self, features: Tensor, chunk: int, absgrad: bool, *, thermal_opacity: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Blends flat features of any width, ``chunk`` channels a traversal, at one opacity.

        Returns the image [..., C, H, W, channels] and the first traversal's transmittance [..., C, H, W, 1].
        """
        if features.shape[-1] <= chunk:
            render, transmittance = self.blend(features, 0, absgrad, thermal_opacity=thermal_opacity)
            return render, transmittance
        self._bin(features)  # all of them are checked for being finite, not only the first chunk
        parts = [
            self.blend(part.contiguous(), 0, absgrad, thermal_opacity=thermal_opacity)
            for part in features.split(chunk, dim=-1)
        ]
        return torch.cat([render for render, _ in parts], -1), parts[0][1]

    def _bin(self, features: Tensor) -> tuple[ProjectedArrays, TileBins]:
        """The bins, made once; ``features`` of the first call are checked for being finite."""
        if self._binned is None:
            opacities = _flat(self.opacities)
            thermal_opacities = opacities if self.thermal_opacities is None else _flat(self.thermal_opacities)
            room = active_pair_capacity()
            limit = room.limit() if room is not None else None
            self._binned = bin_tiles(
                self.projected,
                opacities,
                thermal_opacities,
                features,
                self.settings,
                self.tile_size,
                limit,
                deterministic=self.deterministic,
            )
            if room is not None:
                room.note(to_torch(self._binned[1].pair_ends)[-1:])
        return self._binned

    def info(self) -> RasterizationInfo:
        """gsplat's ``meta`` dictionary, once something has been blended."""
        settings = self.settings
        _, bins = self._binned  # type: ignore[misc]
        shape = self.images_shape
        flatten_ids = to_torch(bins.gaussian_ids)
        tile_offsets = to_torch(bins.tile_offsets)
        values = {
            "batch_ids": None,
            "camera_ids": None,
            "gaussian_ids": None,
            "radii": self.projected.radii.reshape(*shape, -1, 2),
            "means2d": self.means2d,
            "depths": self.depths,
            "opacities": self.opacities,
            "tile_width": bins.tiles_x,
            "tile_height": bins.tiles_y,
            "tiles_per_gauss": to_torch(bins.tiles_per_gaussian).reshape(*shape, -1),
            "flatten_ids": flatten_ids,
            "isect_offsets": tile_offsets[:-1].reshape(*shape, bins.tiles_y, bins.tiles_x),
            "width": settings.width,
            "height": settings.height,
            "tile_size": bins.tile_size,
            "n_batches": math.prod(shape[:-1]),
            "n_cameras": settings.num_cameras,
        }
        if self.thermal_opacities is not None:
            values["thermal_opacities"] = self.thermal_opacities
        depths, tiles = self.projected.depths.detach(), bins.tiles_x * bins.tiles_y
        roots = self.projected.roots
        inputs, scenes, num_gaussians = self._inputs, math.prod(shape[:-1]), settings.num_gaussians
        return RasterizationInfo(
            values,
            {
                "conics": lambda: conics(roots).reshape(*shape, -1, 3),
                "isect_ids": lambda: isect_ids(flatten_ids, tile_offsets, depths, tiles),
                "num_nonfinite": lambda: num_nonfinite(inputs, scenes, num_gaussians),
            },
        )


def _held_by_float32(gradient: Tensor) -> Tensor:
    """Without what overflows where a view matrix has next to no inverse."""
    return torch.where(gradient.abs() < 1e37, gradient, 0.0)


def _flat(opacities: Tensor) -> Tensor:
    """Opacities of all images (or scenes) side by side."""
    return opacities.reshape(-1).contiguous()
