"""Lenses and rolling shutters as gsplat's arguments state them: checked, and packed for the kernels."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import PLAIN_MODELS, check_shape
from thermosplat.rasterizer.call_inputs import PLAIN, Cameras, Splats
from thermosplat.rasterizer.shutter_poses import motions
from warp_kernels.projection.lens_models import LENS_COEFFS, LensModel
from warp_kernels.projection.lens_step import LensSettings

TAKES: dict[str, tuple[str, ...]] = {
    "pinhole": ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs"),
    "ortho": (),
    "fisheye": ("radial_coeffs",),
    "ftheta": ("ftheta_coeffs",),
}
"""The coefficients that each camera model takes."""

RADIAL_COUNTS = {"pinhole": (6, 4), "fisheye": (4,)}
"""How many radial ones; the first is all that there are."""

POLYNOMIAL = 6
"""Coefficients of f-theta's polynomials."""


class RollingShutterType(IntEnum):
    """Which line of an image is read first, and which way; gsplat's names and numbers."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


class FThetaPolynomialType(IntEnum):
    """Which of the two polynomials is the calibration; gsplat's names and numbers."""

    PIXELDIST_TO_ANGLE = 0
    ANGLE_TO_PIXELDIST = 1


@dataclass(frozen=True)
class FThetaCameraDistortionParameters:
    """An f-theta lens with gsplat's names; gsplat's own object will do as well.

    Attributes:
        reference_poly: The polynomial that is exact; of the other one only Newton's method takes its first guess.
        pixeldist_to_angle_poly: Angle to the axis [rad] as a polynomial of the distance from the principal point [px],
            6 coefficients from the constant one on; numbers, or a tensor [6], which gets a gradient.
        angle_to_pixeldist_poly: The distance as a polynomial of the angle, likewise.
        max_angle: Points farther from the axis are not seen [rad].
        linear_cde: c, d and e of the matrix [c, d; e, 1] that maps distances to the image; numbers or a tensor [3].
    """

    reference_poly: FThetaPolynomialType
    pixeldist_to_angle_poly: Sequence[float] | Tensor
    angle_to_pixeldist_poly: Sequence[float] | Tensor
    max_angle: float
    linear_cde: Sequence[float] | Tensor = (1.0, 0.0, 0.0)


class Lenses(NamedTuple):
    """What a render through lenses needs beside what any render needs."""

    settings: LensSettings
    coefficients: Tensor
    """[..., C, LENS_COEFFS]."""
    motions: Tensor | None
    """[..., C, MOTION] with a rolling shutter."""
    viewmats: Tensor
    """[..., C, 4, 4], from where colours are seen: with a rolling shutter, from half way between its two poses."""


def checked_lenses(splats: Splats, cameras: Cameras, width: int, height: int) -> Lenses | None:
    """Checks the arguments that describe lenses and shutters.

    Args:
        splats: Checked; covariances must be None where something is to be returned.
        cameras: Checked but for what is checked here.
        width: Of the image [px], checked.
        height: Of the image [px], checked.

    Returns:
        The lenses; None of plain pinhole, orthographic and fisheye cameras, which are linearised.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    means, viewmats, camera_model = splats.means, cameras.viewmats, cameras.camera_model
    if camera_model in PLAIN_MODELS and cameras.lens == PLAIN:
        return None
    lead = tuple(viewmats.shape[:-2])
    given = cameras.lens._asdict()
    with_ut, shutter, viewmats_rs = given.pop("with_ut"), given.pop("rolling_shutter"), given.pop("viewmats_rs")
    _check_coefficients(camera_model, given, lead, means)
    shutter = _shutter(shutter)
    if shutter is RollingShutterType.GLOBAL:
        if viewmats_rs is not None:
            raise UserError(
                "viewmats_rs was given with a global shutter, which has one pose.",
                "Say how lines are read, as rolling_shutter=RollingShutterType.ROLLING_TOP_TO_BOTTOM, or leave "
                "viewmats_rs out.",
            )
        if camera_model in PLAIN_MODELS and not with_ut and all(value is None for value in given.values()):
            return None
    elif viewmats_rs is None:
        raise UserError(
            f"rolling_shutter={shutter.name} needs viewmats_rs, the poses at the end of the readout, got None.",
            "viewmats are the poses at its beginning.",
        )
    else:
        check_shape("viewmats_rs", viewmats_rs, tuple(viewmats.shape), means, "the shape of viewmats")
    if splats.covars is not None:
        raise UserError(
            "covars cannot be projected through a lens or a rolling shutter: points are taken along a Gaussian's axes.",
            "Give quats and scales.",
        )
    model, coefficients = _packed(camera_model, given, lead, means)
    settings = LensSettings(model, _line_times(shutter, width, height))
    if shutter is RollingShutterType.GLOBAL:
        return Lenses(settings, coefficients, None, viewmats)
    return Lenses(settings, coefficients, *motions(viewmats, cast("Tensor", viewmats_rs)))


def _check_coefficients(camera_model: str, given: dict[str, Any], lead: tuple[int, ...], means: Tensor) -> None:
    """Which coefficients a camera model takes, and of which shape."""
    takes = TAKES[camera_model]
    for name, value in given.items():
        if value is not None and name not in takes:
            others = f"takes {', '.join(takes)}" if takes else "takes no coefficients"
            raise UserError(f"camera_model={camera_model!r} does not take {name}; it {others}.", f"Leave {name} out.")
    radial = given["radial_coeffs"]
    if radial is not None:
        counts = RADIAL_COUNTS[camera_model]
        found = radial.shape[-1] if isinstance(radial, Tensor) and radial.dim() > 0 else 0
        count = found if found in counts else counts[0]
        check_shape("radial_coeffs", radial, (*lead, count), means, f"[..., C, {count}]")
    for name, count in (("tangential_coeffs", 2), ("thin_prism_coeffs", 4)):
        if given[name] is not None:
            check_shape(name, given[name], (*lead, count), means, f"[..., C, {count}]")
    if camera_model == "ftheta" and given["ftheta_coeffs"] is None:
        raise UserError(
            "camera_model='ftheta' needs ftheta_coeffs, got None.",
            "Give an FThetaCameraDistortionParameters.",
        )


def _packed(camera_model: str, given: dict[str, Any], lead: tuple[int, ...], means: Tensor) -> tuple[LensModel, Tensor]:
    """The kernels' name of the lenses, and their coefficients [..., C, LENS_COEFFS] (see lens_models)."""
    if camera_model == "ftheta":
        return _packed_ftheta(given["ftheta_coeffs"], lead, means)
    widths = {"radial_coeffs": 6, "tangential_coeffs": 2, "thin_prism_coeffs": 4}
    parts, missing = [], 0  # zeros that follow one another are one tensor
    for name, width in widths.items():
        part = given[name]
        if part is not None:
            parts += [means.new_zeros((*lead, missing))] if missing else []
            parts.append(part)
            missing, width = 0, width - part.shape[-1]
        missing += width
    parts.append(means.new_zeros((*lead, missing + LENS_COEFFS - sum(widths.values()))))
    beyond = [given[name] for name in ("tangential_coeffs", "thin_prism_coeffs")]
    centred = camera_model == "pinhole" and all(one is None for one in beyond)
    return cast("LensModel", "radial" if centred else camera_model), torch.cat(parts, -1)


def _packed_ftheta(lens: Any, lead: tuple[int, ...], means: Tensor) -> tuple[LensModel, Tensor]:
    """``_packed`` of an f-theta lens, which all cameras share."""
    forward = int(lens.reference_poly) == FThetaPolynomialType.ANGLE_TO_PIXELDIST
    names = ("angle_to_pixeldist_poly", "pixeldist_to_angle_poly")
    row = []
    for name in names if forward else names[::-1]:
        row.append(_numbers(f"ftheta_coeffs.{name}", getattr(lens, name), POLYNOMIAL, means))
    row.append(_numbers("ftheta_coeffs.linear_cde", lens.linear_cde, 3, means))
    row.append(_numbers("ftheta_coeffs.max_angle", [lens.max_angle], 1, means))
    return "ftheta" if forward else "ftheta_inverse", torch.cat(row).expand(*lead, LENS_COEFFS)


def _numbers(name: str, values: Any, count: int, means: Tensor) -> Tensor:
    """So many numbers as a tensor of the means' type."""
    row = values if isinstance(values, Tensor) else means.new_tensor([float(value) for value in values])
    check_shape(name, row, (count,), means)
    return row


def _shutter(value: Any) -> RollingShutterType:
    """gsplat's enumeration, ours, or its name or number; None: a global shutter."""
    if value is None:
        return RollingShutterType.GLOBAL
    name = value if isinstance(value, str) else getattr(value, "name", None)
    if name in RollingShutterType.__members__:
        return RollingShutterType[str(name)]
    if isinstance(value, int) and not isinstance(value, bool) and value in list(RollingShutterType):
        return RollingShutterType(value)
    names = ", ".join(RollingShutterType.__members__)
    raise UserError(f"rolling_shutter must be a RollingShutterType ({names}), got {value!r}.")


def _line_times(shutter: RollingShutterType, width: int, height: int) -> tuple[float, float, float] | None:
    """a, b, c of the time a x + b y + c at which a position [px] is read: 0 in the first line, 1 in the last."""
    if shutter is RollingShutterType.GLOBAL:
        return None
    across = shutter in (RollingShutterType.ROLLING_LEFT_TO_RIGHT, RollingShutterType.ROLLING_RIGHT_TO_LEFT)
    lines = width if across else height
    if lines == 1:
        return 0.0, 0.0, 0.5
    slope, start = 1.0 / (lines - 1), -0.5 / (lines - 1)
    if shutter in (RollingShutterType.ROLLING_BOTTOM_TO_TOP, RollingShutterType.ROLLING_RIGHT_TO_LEFT):
        slope, start = -slope, 1.0 - start
    return (slope, 0.0, start) if across else (0.0, slope, start)
