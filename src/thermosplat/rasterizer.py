"""Differentiable rasterization of 3D Gaussians: gsplat's ``rasterization`` and its RGB + thermal sibling.

Conventions are gsplat 1.5.3's: quaternions (w, x, y, z) of any length, world-to-camera view matrices with OpenCV axes,
pixel centres at half-integers. Leading dimensions ``...`` of the Gaussians are scenes; each scene has C cameras.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from thermosplat.rasterization_arguments import (
    CameraModel,
    RasterizeMode,
    RenderMode,
    check_colors,
    check_limits,
    check_modes,
    check_scene,
    check_shape,
    refuse_unsupported,
)
from thermosplat.warp_bridge import Blend, BlendInputs, Project, ShColors, bin_tiles, to_torch
from warp_kernels.constants import CHANNELS_MAX
from warp_kernels.projection import ProjectionSettings
from warp_kernels.tile_binning import TileBins

__all__ = ["RGBTRender", "rasterization", "rasterization_rgbt"]


class RGBTRender(NamedTuple):
    """What ``rasterization_rgbt`` returns."""

    render_colors: Tensor
    """Colours at the visible opacity, [..., C, H, W, D]."""
    render_features: Tensor
    """Features at the visible opacity, [..., C, H, W, d]."""
    render_thermal_features: Tensor | None
    """The same features at the thermal opacity, [..., C, H, W, d]; None without thermal opacities."""
    render_alphas: Tensor
    """Accumulated visible opacity, [..., C, H, W, 1]."""
    render_thermal_alphas: Tensor | None
    """Accumulated thermal opacity, [..., C, H, W, 1]; None without thermal opacities."""
    info: dict[str, Any]
    """As ``rasterization``'s, with ``thermal_opacities`` beside ``opacities``."""


class RasterizationInfo(dict[str, Any]):
    """The third result of ``rasterization``: gsplat's keys. ``isect_ids`` is computed when first read."""

    def __init__(self, values: dict[str, Any], isect_ids: Callable[[], Tensor]) -> None:
        super().__init__(values, isect_ids=None)
        self._isect_ids = isect_ids

    def __getitem__(self, key: str) -> Any:
        if key == "isect_ids" and super().__getitem__(key) is None:
            self[key] = self._isect_ids()
        return super().__getitem__(key)

    def __iter__(self) -> Iterator[str]:
        # Defined so that dict(info) and {**info} read through __getitem__.
        return super().__iter__()

    def get(self, key: str, default: Any = None) -> Any:
        """As ``dict.get``."""
        value = self[key] if key in self.keys() else default
        return value

    def items(self) -> Any:
        """As ``dict.items``, with every value computed."""
        self["isect_ids"]
        return super().items()

    def values(self) -> Any:
        """As ``dict.values``, with every value computed."""
        self["isect_ids"]
        return super().values()


class _Projected:
    """One projection of a scene and what is shared by everything blended from it. Flat index: image · N + Gaussian."""

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
    ) -> None:
        self.tile_size = tile_size
        self.batch = means.shape[:-2]
        self.settings = settings
        self.means = means.reshape(-1, 3)
        self.viewmats = viewmats.reshape(-1, 4, 4)
        if covars is not None:
            upper = covars[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].reshape(-1, 6).contiguous()
        else:
            upper = None
        if covars is not None or quats is None or scales is None:
            quats, scales = means.new_empty(0, 4), means.new_empty(0, 3)
        bound = opacities.detach().reshape(-1).contiguous()
        thermal_bound = bound if thermal_opacities is None else thermal_opacities.detach().reshape(-1).contiguous()
        means2d, self.depths, conics, compensations, self.radii, self.extents = Project.apply(
            self.means.contiguous(),
            quats.reshape(-1, 4).contiguous(),
            scales.reshape(-1, 3).contiguous(),
            upper,
            bound,
            thermal_bound,
            self.viewmats.contiguous(),
            Ks.reshape(-1, 3, 3).contiguous(),
            settings,
        )
        # The tensors users see lie on the path of the gradient, so that retain_grad() on them works.
        self.means2d = means2d.reshape(*self.images_shape, -1, 2)
        self.conics = conics.reshape(*self.images_shape, -1, 3)
        self.compensations = compensations
        self.opacities = self._per_image_opacities(opacities)
        self.thermal_opacities = None if thermal_opacities is None else self._per_image_opacities(thermal_opacities)
        self._binned: tuple[Any, TileBins] | None = None

    @property
    def images_shape(self) -> tuple[int, ...]:
        return (*self.batch, self.settings.num_cameras)

    def _per_image_opacities(self, opacities: Tensor) -> Tensor:
        per_image = self.per_image(opacities.unsqueeze(-1), per_camera=False).squeeze(-1)
        if self.settings.antialiased:
            per_image = per_image * self.compensations
        return per_image.reshape(*self.images_shape, -1)

    def per_image(self, values: Tensor, *, per_camera: bool) -> Tensor:
        """Values [..., (C,) N, X] repeated for each camera where they are shared, flat [images · N, X]."""
        if not per_camera and self.settings.num_cameras != 1:
            values = values.unsqueeze(-3).expand(*self.images_shape, *values.shape[-2:])
        return values.reshape(-1, values.shape[-1]).contiguous()

    def sh_colors(self, coefficients: Tensor, degree: int, *, per_camera: bool) -> Tensor:
        """Colours [images · N, 3] in the view directions."""
        # inv_ex does not synchronise with the device, as inverse() does.
        camera_positions = torch.linalg.inv_ex(self.viewmats)[0][:, :3, 3].contiguous()
        return ShColors.apply(
            self.means.contiguous(),
            camera_positions,
            coefficients.reshape(-1, *coefficients.shape[-2:]).contiguous(),
            self.radii,
            degree,
            per_camera,
            self.settings.num_gaussians,
            self.settings.num_cameras,
        )

    def blend(
        self, features: Tensor, thermal_channels: int, absgrad: bool, *, thermal_opacity: bool = False
    ) -> list[Tensor]:
        """Blends flat features; with ``thermal_channels``, the last of them a second time at the thermal opacity.

        Returns images [..., C, H, W, channels] and transmittances [..., C, H, W, 1], alternating, a pair an opacity.
        """
        opacities = self.opacities
        if thermal_opacity and self.thermal_opacities is not None:
            opacities = self.thermal_opacities
        inputs = BlendInputs(*self._bin(features), self.settings, thermal_channels, absgrad, [self.means2d])
        results = Blend.apply(
            self.means2d.reshape(-1, 2),
            self.conics.reshape(-1, 3),
            opacities.reshape(-1).contiguous(),
            self.thermal_opacities.reshape(-1).contiguous()
            if thermal_channels and self.thermal_opacities is not None
            else None,
            features,
            inputs,
        )
        shape = (*self.images_shape, self.settings.height, self.settings.width, -1)
        images = []
        for render, transmittance in zip(results[0::2], results[1::2], strict=True):
            images += [render.reshape(shape), transmittance.reshape(shape)]
        return images

    def _bin(self, features: Tensor) -> tuple[Any, TileBins]:
        """The bins, made once; ``features`` of the first call are checked for being finite."""
        if self._binned is None:
            opacities = self.opacities.detach().reshape(-1).contiguous()
            thermal = self.thermal_opacities
            self._binned = bin_tiles(
                self.means2d.detach().reshape(-1, 2),
                self.conics.detach().reshape(-1, 3),
                self.depths.detach(),
                self.compensations.detach(),
                self.radii,
                self.extents,
                opacities,
                opacities if thermal is None else thermal.detach().reshape(-1).contiguous(),
                features.detach(),
                self.settings,
                self.tile_size,
            )
        return self._binned

    def info(self) -> RasterizationInfo:
        """gsplat's ``meta`` dictionary."""
        settings = self.settings
        _, bins = self._binned  # type: ignore[misc]
        shape = self.images_shape
        flatten_ids = to_torch(bins.gaussian_ids)
        tile_offsets = to_torch(bins.tile_offsets)
        values = {
            "batch_ids": None,
            "camera_ids": None,
            "gaussian_ids": None,
            "radii": self.radii.reshape(*shape, -1, 2),
            "means2d": self.means2d,
            "depths": self.depths.reshape(*shape, -1),
            "conics": self.conics,
            "opacities": self.opacities,
            "tile_width": bins.tiles_x,
            "tile_height": bins.tiles_y,
            "tiles_per_gauss": to_torch(bins.tiles_per_gaussian).reshape(*shape, -1),
            "flatten_ids": flatten_ids,
            "isect_offsets": tile_offsets[:-1].reshape(*shape, bins.tiles_y, bins.tiles_x),
            "width": settings.width,
            "height": settings.height,
            "tile_size": bins.tile_size,
            "n_batches": math.prod(self.batch),
            "n_cameras": settings.num_cameras,
        }
        if self.thermal_opacities is not None:
            values["thermal_opacities"] = self.thermal_opacities
        depths, tiles = self.depths.detach(), bins.tiles_x * bins.tiles_y
        return RasterizationInfo(values, lambda: _isect_ids(flatten_ids, tile_offsets, depths, tiles))


def _isect_ids(flatten_ids: Tensor, tile_offsets: Tensor, depths: Tensor, tiles: int) -> Tensor:
    """gsplat's sort keys: image, tile and depth bits packed into an int64, one a (Gaussian, tile) pair."""
    counts = tile_offsets.diff()
    image_tile = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    tile_bits = tiles.bit_length()
    key = ((image_tile // tiles) << tile_bits) | (image_tile % tiles)
    bits = depths.float()[flatten_ids.long()].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    return (key << 32) | bits


@torch.compiler.disable
def rasterization(
    means: Tensor,  # [..., N, 3]
    quats: Tensor | None,  # [..., N, 4]
    scales: Tensor | None,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    colors: Tensor,  # [..., (C,) N, D] or [..., (C,) N, K, 3]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [..., C, D]
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: CameraModel = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,  # [..., N, 3, 3]
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any | None = None,
    rolling_shutter: Any | None = None,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders Gaussians with any number of channels; gsplat 1.5.3's ``rasterization`` in signature and meaning.

    Differentiable in means, quats, scales, opacities, colors, covars, viewmats, backgrounds and (unlike gsplat) Ks.
    Runs on the CPU and on CUDA, in float32 or float64. A Gaussian with anything non-finite is invisible.

    Args:
        means: Centres, [..., N, 3], world units.
        quats: Rotations (w, x, y, z) of any length, [..., N, 4]. Ignored (may be None) when ``covars`` is given.
        scales: Standard deviations along the Gaussian's axes, [..., N, 3], world units. Ignored with ``covars``.
        opacities: In [0, 1], [..., N].
        colors: Features [..., N, D] or per camera [..., C, N, D]; with ``sh_degree``, coefficients [..., N, K, 3] or
            [..., C, N, K, 3] with K at least (sh_degree + 1)².
        viewmats: World-to-camera, OpenCV axes, [..., C, 4, 4].
        Ks: Intrinsics, [..., C, 3, 3], px.
        width: Image width [px].
        height: Image height [px].
        near_plane: Gaussians nearer than this are not drawn [world units].
        far_plane: Gaussians farther than this are not drawn [world units].
        radius_clip: Gaussians whose radii are both at most this are not drawn [px].
        eps2d: Added to the diagonal of the 2D covariance [px²].
        sh_degree: Active degree, 0 to 3; None: ``colors`` are final values.
        packed: Accepted for gsplat's sake; the result and its layout are those of ``packed=False``.
        tile_size: 8, 16 or 32 [px]; changes speed only.
        backgrounds: Colours behind everything, [..., C, D].
        render_mode: "RGB", "D" (accumulated depth), "ED" (expected depth), "RGB+D" or "RGB+ED".
        sparse_grad: Not supported.
        absgrad: The backward pass sets ``info["means2d"].absgrad`` to the sums of absolute per-pixel gradients.
        rasterize_mode: "classic", or "antialiased": opacities are scaled by what ``eps2d`` adds to the area
            (Mip-Splatting).
        channel_chunk: At most so many channels are blended in one traversal (never more than 32).
        distributed: Not supported.
        camera_model: "pinhole" or "ortho".
        segmented: Not supported.
        covars: Symmetric covariances, [..., N, 3, 3], world units²; only the upper triangle is read.
        with_ut: Not supported.
        with_eval3d: Not supported.
        radial_coeffs: Not supported: undistort images first.
        tangential_coeffs: Not supported.
        thin_prism_coeffs: Not supported.
        ftheta_coeffs: Not supported.
        rolling_shutter: Not supported.
        viewmats_rs: Not supported.

    Returns:
        ``(render_colors, render_alphas, info)``: images [..., C, H, W, X] with X = D, 1 or D + 1; accumulated
        opacities [..., C, H, W, 1]; gsplat's dictionary of intermediate results.

    Raises:
        UserError: if an argument has the wrong shape, type or device, or asks for what is not supported.

    Example:
        >>> import torch
        >>> from thermosplat import rasterization
        >>> n = 100
        >>> colors, alphas, info = rasterization(
        ...     means=torch.randn(n, 3), quats=torch.randn(n, 4), scales=0.1 * torch.rand(n, 3),
        ...     opacities=torch.rand(n), colors=torch.rand(n, 3),
        ...     viewmats=torch.eye(4)[None], Ks=torch.tensor([[[300.0, 0, 150], [0, 300, 100], [0, 0, 1]]]),
        ...     width=300, height=200)
        >>> colors.shape, alphas.shape
        (torch.Size([1, 200, 300, 3]), torch.Size([1, 200, 300, 1]))
    """
    refuse_unsupported(
        sparse_grad=sparse_grad,
        distributed=distributed,
        segmented=segmented,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs,
        tangential_coeffs=tangential_coeffs,
        thin_prism_coeffs=thin_prism_coeffs,
        ftheta_coeffs=ftheta_coeffs,
        rolling_shutter=rolling_shutter,
        viewmats_rs=viewmats_rs,
    )
    check_modes(render_mode, rasterize_mode, camera_model, tile_size, width, height, sh_degree)
    check_limits(near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d)
    cameras, count = check_scene(means, quats, scales, covars, opacities, viewmats, Ks)
    per_camera = check_colors("colors", colors, means, cameras, sh_degree)
    batch = means.shape[:-2]
    if backgrounds is not None:
        channels = 3 if sh_degree is not None else colors.shape[-1]
        check_shape("backgrounds", backgrounds, (*batch, cameras, channels), means)
    settings = ProjectionSettings(
        width=width,
        height=height,
        num_gaussians=count,
        num_cameras=cameras,
        num_images=math.prod(batch) * cameras,
        eps2d=eps2d,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        antialiased=rasterize_mode == "antialiased",
        camera_model=camera_model,
    )
    scene = _Projected(means, quats, scales, covars, opacities, None, viewmats, Ks, settings, tile_size)

    columns = []
    if "RGB" in render_mode:
        if sh_degree is None:
            columns.append(scene.per_image(colors, per_camera=per_camera))
        else:
            columns.append(scene.sh_colors(colors, sh_degree, per_camera=per_camera))
    if "D" in render_mode:
        columns.append(scene.depths[:, None])
        if backgrounds is not None:
            # Depth has no background, as in gsplat.
            zero = backgrounds.new_zeros(*backgrounds.shape[:-1], 1)
            backgrounds = torch.cat([backgrounds, zero], -1) if "RGB" in render_mode else zero
    features = columns[0] if len(columns) == 1 else torch.cat(columns, -1)

    render_colors, transmittance = _blend_in_chunks(scene, features, min(channel_chunk, CHANNELS_MAX), absgrad)
    render_alphas = 1.0 - transmittance
    if backgrounds is not None:
        render_colors = render_colors + transmittance * backgrounds[..., None, None, :]
    if "ED" in render_mode:
        expected = render_colors[..., -1:] / render_alphas.clamp(min=1e-10)
        render_colors = torch.cat([render_colors[..., :-1], expected], -1)
    return render_colors, render_alphas, scene.info()


def _blend_in_chunks(
    scene: _Projected, features: Tensor, chunk: int, absgrad: bool, *, thermal_opacity: bool = False
) -> tuple[Tensor, Tensor]:
    """Blends features of any width; the transmittance comes from the first traversal."""
    if features.shape[-1] <= chunk:
        render, transmittance = scene.blend(features, 0, absgrad, thermal_opacity=thermal_opacity)
        return render, transmittance
    scene._bin(features)
    parts = [
        scene.blend(part.contiguous(), 0, absgrad, thermal_opacity=thermal_opacity)
        for part in features.split(chunk, dim=-1)
    ]
    return torch.cat([render for render, _ in parts], -1), parts[0][1]


@torch.compiler.disable
def rasterization_rgbt(
    means: Tensor,  # [..., N, 3]
    quats: Tensor,  # [..., N, 4]
    scales: Tensor,  # [..., N, 3]
    opacities: Tensor,  # [..., N]
    thermal_opacities: Tensor | None,  # [..., N]
    colors: Tensor,  # [..., (C,) N, 3] or [..., (C,) N, K, 3]
    features: Tensor,  # [..., (C,) N, d]
    viewmats: Tensor,  # [..., C, 4, 4]
    Ks: Tensor,  # [..., C, 3, 3]
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [..., C, 3]
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    camera_model: CameraModel = "pinhole",
) -> RGBTRender:
    """Renders colours and features at one opacity and the same features at another, in one traversal.

    ThermoSplat's two rasterization passes (method equations 1 and 2): equal to ``rasterization`` of colours and
    features at ``opacities`` and of features at ``thermal_opacities``, with one projection and one sorted list.

    Args:
        means: Centres, [..., N, 3], world units.
        quats: Rotations (w, x, y, z) of any length, [..., N, 4].
        scales: Standard deviations, [..., N, 3], world units.
        opacities: Visible opacities α in [0, 1], [..., N].
        thermal_opacities: Thermal opacities α_t in [0, 1], [..., N]. None: only the visible pass is rendered.
        colors: As in ``rasterization``; with ``sh_degree``, SH coefficients.
        features: Latent features, [..., N, d] or [..., C, N, d].
        viewmats: World-to-camera, OpenCV axes, [..., C, 4, 4].
        Ks: Intrinsics, [..., C, 3, 3], px.
        width: Image width [px].
        height: Image height [px].
        near_plane: As in ``rasterization``.
        far_plane: As in ``rasterization``.
        radius_clip: As in ``rasterization``.
        eps2d: As in ``rasterization``.
        sh_degree: As in ``rasterization``.
        tile_size: As in ``rasterization``.
        backgrounds: Colours behind ``colors`` only, [..., C, D].
        absgrad: As in ``rasterization``; both passes' per-pixel gradients are summed before the absolute value.
        rasterize_mode: As in ``rasterization``.
        camera_model: As in ``rasterization``.

    Returns:
        The five images and the info dictionary. The gradient of ``info["means2d"]`` is the sum over both passes.

    Raises:
        UserError: if an argument has the wrong shape, type or device, or asks for what is not supported.
    """
    check_modes("RGB", rasterize_mode, camera_model, tile_size, width, height, sh_degree)
    check_limits(near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d)
    cameras, count = check_scene(means, quats, scales, None, opacities, viewmats, Ks)
    batch = means.shape[:-2]
    if thermal_opacities is not None:
        check_shape("thermal_opacities", thermal_opacities, (*batch, count), means)
    colors_per_camera = check_colors("colors", colors, means, cameras, sh_degree)
    features_per_camera = check_colors("features", features, means, cameras, None)
    channels = 3 if sh_degree is not None else colors.shape[-1]
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (*batch, cameras, channels), means)
    settings = ProjectionSettings(
        width=width,
        height=height,
        num_gaussians=count,
        num_cameras=cameras,
        num_images=math.prod(batch) * cameras,
        eps2d=eps2d,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        antialiased=rasterize_mode == "antialiased",
        camera_model=camera_model,
    )
    scene = _Projected(means, quats, scales, None, opacities, thermal_opacities, viewmats, Ks, settings, tile_size)
    if sh_degree is None:
        flat_colors = scene.per_image(colors, per_camera=colors_per_camera)
    else:
        flat_colors = scene.sh_colors(colors, sh_degree, per_camera=colors_per_camera)
    flat_features = scene.per_image(features, per_camera=features_per_camera)
    both = torch.cat([flat_colors, flat_features], -1)
    dim = features.shape[-1]
    render_thermal, thermal_alphas = None, None
    if thermal_opacities is not None and channels + 2 * dim <= CHANNELS_MAX:
        render, transmittance, render_thermal, thermal_transmittance = scene.blend(both, dim, absgrad)
        thermal_alphas = 1.0 - thermal_transmittance
    else:
        render, transmittance = _blend_in_chunks(scene, both, CHANNELS_MAX, absgrad)
        if thermal_opacities is not None:
            render_thermal, thermal_transmittance = _blend_in_chunks(
                scene, flat_features, CHANNELS_MAX, absgrad, thermal_opacity=True
            )
            thermal_alphas = 1.0 - thermal_transmittance
    render_colors, render_features = render[..., :channels], render[..., channels:]
    if backgrounds is not None:
        render_colors = render_colors + transmittance * backgrounds[..., None, None, :]
    return RGBTRender(render_colors, render_features, render_thermal, 1.0 - transmittance, thermal_alphas, scene.info())
