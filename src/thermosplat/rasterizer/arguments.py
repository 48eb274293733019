"""Checks of the rasterizer's arguments: each failure says what was expected, what was found and what is supported.

A call whose arguments are right passes few conditions here. Numbers and words are checked once for the same ones.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast, get_args

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.call_inputs import CameraModel, Cameras, Drawn, RasterizeMode, RenderMode, Splats
from thermosplat.rasterizer.checked_numbers import as_whole, checked_limits, checked_sizes
from thermosplat.rasterizer.graph_breaks import refuse_transforms
from warp_kernels.constants import SH_DEGREE_MAX, TILE_SIZES
from warp_kernels.projection.plain_cameras import CameraModel as PlainCameraModel
from warp_kernels.projection.projection import ProjectionSettings
from warp_kernels.projection.unscented_ellipse import ALPHA, BETA

Arguments = ParamSpec("Arguments")
Found = TypeVar("Found")

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

_OF_PYTHON = frozenset((int, float, bool, str, type(None)))

_MEANINGS = {
    "quats": "[..., N, 4] with N from means",
    "scales": "[..., N, 3] with N from means",
    "covars": "[..., N, 3, 3] with N from means, or [..., N, 6]",
    "opacities": "[..., N] with N from means",
    "viewmats": "[..., C, 4, 4]",
    "Ks": "[..., C, 3, 3] with C from viewmats",
}
"""Shapes in letters, for messages."""


def remembered(check: Callable[Arguments, Found]) -> Callable[Arguments, Found]:
    """Lets a check of numbers and words, which depends on nothing else, do its work once for the same arguments.

    Only for Python's own kinds, which cannot change; 1, 1.0 and True are not the same. What is refused is checked anew.

    Args:
        check: Raises, or returns something that nobody changes.

    Returns:
        It, to be called by position.
    """
    known = functools.lru_cache(maxsize=256, typed=True)(check)

    @functools.wraps(check)
    def checked(*arguments: Arguments.args, **named: Arguments.kwargs) -> Found:
        if not named and _OF_PYTHON.issuperset(map(type, arguments)):
            return known(*arguments)
        return check(*arguments, **named)

    return checked


def refuse_unsupported(**arguments: Any) -> None:
    """Raises for arguments of ``IN_PLACE`` that were given.

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

    Raises:
        UserError: naming the argument, what is supported, and what was given.
    """
    allowed = CHOICES[name if name in CHOICES else "sh_degree"]
    # 16.0 and True equal whole numbers and are none
    if not (value is None or isinstance(value, str) or type(value) is int) or value not in allowed:
        raise UserError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}.")


@remembered
def checked_choice(name: str, value: Any) -> Any:
    """As ``check_choice``, of a whole number of any kind.

    Returns:
        The same as Python's number.
    """
    value = as_whole(value)
    check_choice(name, value)
    return value


def check_is_dense(name: str, tensor: Any) -> None:
    """Checks that an argument is a tensor whose numbers lie in memory.

    Raises:
        UserError: naming the argument and what was found.
    """
    if not isinstance(tensor, Tensor):
        raise UserError(f"{name} must be a torch.Tensor, got {type(tensor).__name__}.")
    if tensor.layout is not torch.strided:
        layout = str(tensor.layout).removeprefix("torch.")
        raise UserError(f"{name} must be a dense tensor, got one of layout {layout}.", f"Use {name}.to_dense().")


def check_shape(name: str, tensor: Any, shape: tuple[int, ...], means: Tensor, meaning: str = "") -> None:
    """Checks a tensor's type, shape, dtype and device against the means'.

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
    check_is_dense(name, tensor)
    if tensor.shape != shape:
        letters = f" = {meaning}" if meaning else ""
        raise UserError(f"{name} must have shape {list(shape)}{letters}, got {list(tensor.shape)}.")
    if tensor.dtype != means.dtype:
        raise UserError(f"{name} must have the dtype of means, {means.dtype}, got {tensor.dtype}.")
    if tensor.device != means.device:
        raise UserError(f"{name} must be on the device of means, {means.device}, got {tensor.device}.")


def check_scene(splats: Splats, cameras: Cameras) -> None:
    """Checks Gaussians and cameras.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    means, quats, scales, opacities, covars, thermal_opacities = splats
    viewmats, Ks = cameras[:2]
    if torch._C._are_functorch_transforms_active():
        refuse_transforms()
    check_is_dense("means", means)
    if not (means.is_cuda or means.is_cpu):
        raise UserError(f"means must be on the CPU or on a CUDA device, got {means.device}.")
    if means.dim() < 2 or means.shape[-1] != 3:
        raise UserError(f"means must have shape [..., N, 3], got {list(means.shape)}.")
    dtype, device = means.dtype, means.device
    if dtype not in (torch.float32, torch.float64):
        raise UserError(f"means must be float32 or float64, got {dtype}.")
    *batch, count, _ = means.shape
    wanted: list[tuple[str, Any, tuple[int, ...]]]
    if covars is None:
        if quats is None or scales is None:
            raise UserError(f"{'quats' if quats is None else 'scales'} must be given unless covars is, got None.")
        wanted = [("quats", quats, (*batch, count, 4)), ("scales", scales, (*batch, count, 3))]
    else:
        rows = (6,) if isinstance(covars, Tensor) and covars.shape[-1:] == (6,) else (3, 3)
        wanted = [("covars", covars, (*batch, count, *rows))]
    wanted.append(("opacities", opacities, (*batch, count)))
    if not isinstance(viewmats, Tensor) or viewmats.dim() != len(batch) + 3:
        found = list(viewmats.shape) if isinstance(viewmats, Tensor) else type(viewmats).__name__
        raise UserError(f"viewmats must have shape {[*batch, 'C', 4, 4]}, got {found}.")
    number = viewmats.shape[-3]
    wanted += [("viewmats", viewmats, (*batch, number, 4, 4)), ("Ks", Ks, (*batch, number, 3, 3))]
    if thermal_opacities is not None:
        wanted.append(("thermal_opacities", thermal_opacities, (*batch, count)))
    for name, tensor, shape in wanted:
        if not (
            isinstance(tensor, Tensor)
            and tensor.shape == shape
            and tensor.dtype is dtype
            and tensor.device == device
            and tensor.layout is torch.strided
        ):
            check_shape(name, tensor, shape, means, _MEANINGS.get(name, ""))
    if number == 0:
        raise UserError("viewmats must hold at least one camera, got 0.")


def check_color_choice(colors: Any, sh_degree: int | None, render_mode: str) -> None:
    """Checks that there are colours where they are shown, and no degree without them.

    Args:
        colors: of any kind, or None.
        sh_degree: active degree or None.

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


def checked_settings(splats: Splats, cameras: Cameras, drawn: Drawn) -> tuple[ProjectionSettings, int]:
    """Checks what is projected, and how, and gives the projection's settings.

    Args:
        drawn: as given; the values are not looked at.

    Returns:
        The settings, with the numbers of Gaussians, cameras and images, and the edge of a tile [px], all of them in
        Python's own numbers.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    check_scene(splats, cameras)
    *batch, count, _ = splats.means.shape
    number = cameras.viewmats.shape[-3]
    images = math.prod(batch) * number
    return _settings(count, number, images, *cameras[2:7], *drawn[1:5])


@remembered
def _settings(
    count: int,
    cameras: int,
    images: int,
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    camera_model: CameraModel,
    radius_clip: float,
    eps2d: float,
    tile_size: int,
    rasterize_mode: str,
) -> tuple[ProjectionSettings, int]:
    """The settings of checked tensors, whose counts are given."""
    tile_size = checked_choice("tile_size", tile_size)
    check_choice("rasterize_mode", rasterize_mode)
    check_choice("camera_model", camera_model)
    width, height = checked_sizes(width=width, height=height)
    limits = checked_limits(near_plane=near_plane, far_plane=far_plane, radius_clip=radius_clip, eps2d=eps2d)
    if images * count >= INDEX_MAX or images * height >= INDEX_MAX:
        raise UserError(
            f"{count:,} Gaussians in each of {images:,} images of {width} x {height} px are more than the kernels can "
            f"number ({INDEX_MAX - 1:,} Gaussians, and as many rows, over all images).",
            "Render fewer cameras per call.",
        )
    settings = ProjectionSettings(
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
    return settings, tile_size
