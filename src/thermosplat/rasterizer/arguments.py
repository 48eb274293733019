"""Checks of the rasterizer's arguments: each failure says what was expected, what was found and what is supported."""

import math
from typing import Any, Literal, cast, get_args

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.checked_numbers import checked_limits, checked_sizes, remembered
from thermosplat.rasterizer.graph_breaks import refuse_transforms
from warp_kernels.constants import SH_DEGREE_MAX, TILE_SIZES
from warp_kernels.projection.plain_cameras import CameraModel as PlainCameraModel
from warp_kernels.projection.projection import ProjectionSettings
from warp_kernels.projection.unscented_ellipse import ALPHA, BETA

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED", "d", "Ed", "RGB-d", "RGB-Ed"]
RasterizeMode = Literal["classic", "antialiased"]
CameraModel = Literal["pinhole", "ortho", "fisheye", "ftheta"]

PLAIN_MODELS = get_args(PlainCameraModel)
"""Cameras that are linearised where nothing asks for the unscented transform."""

INDEX_MAX = 2**31
"""Kernels number (image, Gaussian) pairs and rows of images with 32 bits."""

CHOICES: dict[str, tuple[Any, ...]] = {
    "render_mode": get_args(RenderMode),
    "rasterize_mode": get_args(RasterizeMode),
    "camera_model": get_args(CameraModel),
    "tile_size": TILE_SIZES,
    "sh_degree": (None, *range(SH_DEGREE_MAX + 1)),
}
"""Arguments of which there are few, and what they may be."""

IN_PLACE = {
    "lidar_coeffs": "cameras are pinhole, ortho, fisheye or ftheta",
    "external_distortion_coeffs": "lenses distort: radial_coeffs, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs",
    "ut_params": "the unscented transform has gsplat's defaults, alpha = 0.1, beta = 2 and kappa = 0",
    "renderer_config": "rays are blended in one way, and gsplat's two renderers differ in speed alone",
}
"""Arguments of gsplat that only have their default here, and what there is."""

UT_PARAMS = {"alpha": ALPHA, "beta": BETA, "kappa": 0.0}
"""Of gsplat's ``UnscentedTransformParameters``."""


def refuse_unsupported(**arguments: Any) -> None:
    """Raises for arguments of ``IN_PLACE`` that were given.

    Args:
        **arguments: By name.

    Raises:
        UserError: naming the argument and what there is.
    """
    for name, value in arguments.items():
        if value is not None and not _is_what_there_is(name, value):
            raise UserError(f"rasterization() does not support {name}: {IN_PLACE[name]}.", f"Leave {name} out.")


def _is_what_there_is(name: str, value: Any) -> bool:
    """Whether an object of gsplat's asks for nothing else than what is done anyway."""
    if name == "renderer_config":
        return type(value).__name__ in ("RendererConfig_MixedBatch", "RendererConfig_ParallelBatch")
    alike = (math.isclose(getattr(value, key, math.nan), one, rel_tol=1e-6) for key, one in UT_PARAMS.items())
    return name == "ut_params" and all(alike)


def check_choice(name: str, value: Any) -> None:
    """Checks an argument of ``CHOICES``.

    Args:
        name: of the argument; what is none of them is a degree of spherical harmonics.
        value: what was given, a whole number ``as_whole``.

    Raises:
        UserError: naming the argument, what is supported, and what was given.
    """
    allowed = CHOICES[name if name in CHOICES else "sh_degree"]
    # 16.0 and True equal whole numbers and are none
    if not (value is None or isinstance(value, str) or type(value) is int) or value not in allowed:
        raise UserError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}.")


def _check_tensor(name: str, tensor: Any) -> None:
    """Checks that an argument is a tensor whose numbers lie in memory."""
    if not isinstance(tensor, Tensor):
        raise UserError(f"{name} must be a torch.Tensor, got {type(tensor).__name__}.")
    if tensor.layout is not torch.strided:
        layout = str(tensor.layout).removeprefix("torch.")
        raise UserError(f"{name} must be a dense tensor, got one of layout {layout}.", f"Use {name}.to_dense().")


def check_shape(name: str, tensor: Any, shape: tuple[int, ...], means: Tensor, meaning: str = "") -> None:
    """Checks a tensor's type, shape, dtype and device against the means'.

    Args:
        name: of the argument.
        tensor: what was given.
        shape: what it must have.
        means: the tensor that fixes dtype and device.
        meaning: the shape in letters, for the message.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    if (
        isinstance(tensor, Tensor)
        and tensor.layout is torch.strided
        and tensor.shape == shape
        and tensor.dtype is means.dtype
        and tensor.device == means.device
    ):
        return
    _check_tensor(name, tensor)
    if tensor.shape != shape:
        letters = f" = {meaning}" if meaning else ""
        raise UserError(f"{name} must have shape {list(shape)}{letters}, got {list(tensor.shape)}.")
    if tensor.dtype != means.dtype:
        raise UserError(f"{name} must have the dtype of means, {means.dtype}, got {tensor.dtype}.")
    if tensor.device != means.device:
        raise UserError(f"{name} must be on the device of means, {means.device}, got {tensor.device}.")


def check_scene(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
) -> tuple[int, int]:
    """Checks Gaussians and cameras.

    Args:
        means: [..., N, 3].
        quats: [..., N, 4], or None with covars.
        scales: [..., N, 3], or None with covars.
        covars: [..., N, 3, 3] or None.
        opacities: [..., N].
        viewmats: [..., C, 4, 4].
        Ks: [..., C, 3, 3].

    Returns:
        The number of cameras per scene and of Gaussians per scene.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    refuse_transforms()
    _check_tensor("means", means)
    if not (means.is_cuda or means.is_cpu):
        raise UserError(f"means must be on the CPU or on a CUDA device, got {means.device}.")
    if means.dim() < 2 or means.shape[-1] != 3:
        raise UserError(f"means must have shape [..., N, 3], got {list(means.shape)}.")
    if means.dtype not in (torch.float32, torch.float64):
        raise UserError(f"means must be float32 or float64, got {means.dtype}.")
    *batch, count, _ = means.shape
    if covars is None:
        for name, value in (("quats", quats), ("scales", scales)):
            if value is None:
                raise UserError(f"{name} must be given unless covars is, got None.")
        check_shape("quats", quats, (*batch, count, 4), means, "[..., N, 4] with N from means")
        check_shape("scales", scales, (*batch, count, 3), means, "[..., N, 3] with N from means")
    else:
        meaning = "[..., N, 3, 3] with N from means, or [..., N, 6]"
        check_shape("covars", covars, (*batch, count, 3, 3), means, meaning)
    check_shape("opacities", opacities, (*batch, count), means, "[..., N] with N from means")
    if not isinstance(viewmats, Tensor) or viewmats.dim() != len(batch) + 3:
        found = list(viewmats.shape) if isinstance(viewmats, Tensor) else type(viewmats).__name__
        raise UserError(f"viewmats must have shape {[*batch, 'C', 4, 4]}, got {found}.")
    cameras = viewmats.shape[-3]
    check_shape("viewmats", viewmats, (*batch, cameras, 4, 4), means, "[..., C, 4, 4]")
    check_shape("Ks", Ks, (*batch, cameras, 3, 3), means, "[..., C, 3, 3] with C from viewmats")
    if cameras == 0:
        raise UserError("viewmats must hold at least one camera, got 0.")
    return cameras, count


def check_colors(
    name: str, colors: Tensor | tuple[Tensor, Tensor], means: Tensor, cameras: int, sh_degree: int | None
) -> bool:
    """Checks colours or features.

    Args:
        name: of the argument.
        colors: [..., (C,) N, D], or with ``sh_degree`` [..., (C,) N, K, 3] or the pair of its first coefficient
            [..., (C,) N, 1, 3] and the others [..., (C,) N, K - 1, 3].
        means: [..., N, 3].
        cameras: C.
        sh_degree: active degree or None.

    Returns:
        Whether there are values of their own for each camera.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    if isinstance(colors, tuple):
        if len(colors) == 2 and sh_degree is not None:
            return _check_pair(name, *colors, means, cameras, sh_degree)
        raise UserError(f"{name} must be a torch.Tensor, got {type(colors).__name__}.")
    _check_tensor(name, colors)
    *batch, count, _ = means.shape
    shape, tail = tuple(colors.shape), 1 if sh_degree is None else 2
    per_camera = len(shape) == len(batch) + 2 + tail
    lead = (*batch, cameras, count) if per_camera else (*batch, count)
    letters = "[..., (C,) N, D]" if sh_degree is None else "[..., (C,) N, K, 3]"
    if len(shape) != len(lead) + tail or shape[: len(lead)] != lead:
        expected = f"{letters} with N = {count} (from means) and C = {cameras} (from viewmats)"
        mode = "without sh_degree" if sh_degree is None else f"with sh_degree={sh_degree}"
        raise UserError(f"{name} {mode} must have shape {expected}, got {list(colors.shape)}.")
    check_shape(name, colors, shape, means)
    if shape[-1] < 1:
        raise UserError(f"{name} must have at least one channel, got {list(colors.shape)}.")
    if sh_degree is None:
        return per_camera
    needed = (sh_degree + 1) ** 2
    if shape[-1] != 3 or shape[-2] < needed:
        raise UserError(
            f"{name} must hold at least {needed} coefficients of 3 channels for sh_degree={sh_degree} "
            f"({letters}), got {list(colors.shape)}."
        )
    return per_camera


def _check_pair(name: str, sh0: Tensor, shN: Tensor, means: Tensor, cameras: int, sh_degree: int) -> bool:
    """``check_colors`` of coefficients in two tensors."""
    per_camera = check_colors(f"{name}[0]", sh0, means, cameras, 0)
    check_shape(f"{name}[0]", sh0, (*sh0.shape[:-2], 1, 3), means)
    needed = (sh_degree + 1) ** 2 - 1
    given = shN.shape[-2] if isinstance(shN, Tensor) and shN.dim() > 1 else 0
    check_shape(f"{name}[1]", shN, (*sh0.shape[:-2], max(given, needed), 3), means)
    return per_camera


def check_color_choice(colors: Any, sh_degree: int | None, render_mode: str) -> None:
    """Checks that there are colours where they are shown, and no degree without them.

    Args:
        colors: of any kind, or None.
        sh_degree: active degree or None.
        render_mode: one of them.

    Raises:
        UserError: saying what goes together.
    """
    if colors is None and "RGB" in render_mode:
        raise UserError(f"colors must be given with render_mode={render_mode!r}, got None.", "Render a depth mode.")
    if colors is None and sh_degree is not None:
        raise UserError(f"sh_degree must be None where colors is None, got {sh_degree}.")


def check_backgrounds(backgrounds: Tensor | None, channels: int, means: Tensor, cameras: int) -> None:
    """Checks the colours behind everything.

    Whether they are finite is asked for on the CPU alone: a CUDA device would have to finish its work for the answer.

    Args:
        backgrounds: [..., C, D] or None.
        channels: D.
        means: [..., N, 3].
        cameras: C.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (*means.shape[:-2], cameras, channels), means)
        if backgrounds.device.type == "cpu" and not backgrounds.detach().isfinite().all():
            raise UserError("backgrounds must be finite, found a NaN or an infinity: every pixel would show it.")


def checked_settings(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    *,
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    tile_size: int,
    rasterize_mode: str,
    camera_model: CameraModel,
) -> ProjectionSettings:
    """Checks what is projected, and how, and gives the projection's settings.

    ``tile_size``, which is not among them, is to be given ``as_whole``.

    Returns:
        The settings in Python's own numbers, with the numbers of Gaussians, cameras and images.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    cameras, count = check_scene(means, quats, scales, covars, opacities, viewmats, Ks)
    planes = (near_plane, far_plane, radius_clip, eps2d)
    images = math.prod(means.shape[:-2]) * cameras
    return _settings(count, cameras, images, width, height, *planes, tile_size, rasterize_mode, camera_model)


@remembered
def _settings(
    count: int,
    cameras: int,
    images: int,
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    tile_size: int,
    rasterize_mode: str,
    camera_model: CameraModel,
) -> ProjectionSettings:
    """The settings of checked tensors, whose counts are given."""
    check_choice("rasterize_mode", rasterize_mode)
    check_choice("camera_model", camera_model)
    check_choice("tile_size", tile_size)
    width, height = checked_sizes(width=width, height=height)
    limits = checked_limits(near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d)
    if images * count >= INDEX_MAX or images * height >= INDEX_MAX:
        raise UserError(
            f"{count:,} Gaussians in each of {images:,} images of {width} x {height} px are more than the kernels can "
            f"number ({INDEX_MAX - 1:,} Gaussians, and as many rows, over all images).",
            "Render fewer cameras per call.",
        )
    return ProjectionSettings(
        width=width,
        height=height,
        num_gaussians=count,
        num_cameras=cameras,
        num_images=images,
        **limits,
        antialiased=rasterize_mode == "antialiased",
        # the others have lenses, whose kernels do not read this
        camera_model=cast("PlainCameraModel", camera_model if camera_model in PLAIN_MODELS else "pinhole"),
    )
