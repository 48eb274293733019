"""How far the images and gradients of two renderers are apart, and when that is too far to compare their times."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch


class Tolerance(NamedTuple):
    """What still counts as the same rendering.

    Attributes:
        pixel: images agree when fewer than ``share`` of their values differ by more than this.
        share: see ``pixel``.
        gradient: largest relative difference of a gradient, in the Euclidean norm.
    """

    pixel: float
    share: float
    gradient: float


SAME_CONVENTIONS = Tolerance(1e-4, 1e-3, 1e-2)
"""Two implementations that round differently may decide differently at alpha = 1/255 or transmittance = 1e-4, which
shows in single pixels, and makes up nearly all of the gradients' difference too."""

OTHER_CONVENTIONS = Tolerance(2e-2, 1e-2, 0.2)
"""For renderers that clamp alpha at 0.99 instead of 0.999 and cut Gaussians off at three standard deviations, where
they still have an alpha of 0.011. A wrong camera, order or activation is far beyond it."""


def largest(values: Iterable[float]) -> float:
    """The largest of some numbers, NaN where one of them is: Python's max() passes over it unless it is the first."""
    return torch.tensor([*values], dtype=torch.float64).max().item()


def differences(one: tuple[Any, Any], other: tuple[Any, Any], names: list[str], pixel: float) -> dict[str, float]:
    """How far images and gradients of two renderers are apart.

    Args:
        one: images and gradients.
        other: those it is compared with.
        names: of the gradients.
        pixel: threshold of ``image_share``.

    Returns:
        ``image_mean``, ``image_rms`` and ``image_max`` of the absolute differences of all colours and alphas,
        ``image_share`` of them above ``pixel``, and the relative difference of each gradient as ``grad_NAME``.
    """
    total = squares = above = 0.0
    most: list[float] = []
    count = 0
    for a, b in zip(one[0], other[0], strict=True):
        off = (a.detach().double() - b.detach().double()).abs()
        total += off.sum().item()
        squares += off.square().sum().item()
        most.append(off.max().item())
        above += (~(off <= pixel)).double().sum().item()
        count += off.numel()
    result = {
        "image_mean": total / count,
        "image_rms": (squares / count) ** 0.5,
        "image_max": largest(most),
        "image_share": above / count,
    }
    for name, a, b in zip(names, one[1], other[1], strict=True):
        result[f"grad_{name}"] = ((a.double() - b.double()).norm() / b.double().norm().clamp(min=1e-30)).item()
    return result


def disagreement(found: dict[str, float], tolerance: Tolerance) -> str | None:
    """What is too far apart to compare times, if anything.

    Args:
        found: from ``differences`` with the tolerance's pixel threshold.
        tolerance: what is allowed.
    """
    if not found["image_share"] <= tolerance.share:
        return f"images differ: {found['image_share']:.1%} of the values by more than {tolerance.pixel:g}"
    wrong = [f"{k} {v:.1e}" for k, v in found.items() if k.startswith("grad_") and not v <= tolerance.gradient]
    return f"gradients differ: {', '.join(wrong)}" if wrong else None
