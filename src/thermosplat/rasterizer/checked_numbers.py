"""Numbers among the rasterizer's arguments, of any library's kind, as Python's own."""

import math
import operator
from typing import Any

import torch

from thermosplat.errors import UserError

SIZE_MAX = 2**24
"""Width and height of an image, at most [px]: float32 holds the pixels' places up to there."""


def as_whole(number: Any) -> Any:
    """A whole number of any kind (NumPy's, torch's) as Python's own, which the kernels' arguments are packed from.

    Args:
        number: anything; what is no whole number, as a bool or a float, stays as it is, to be refused.
    """
    if number is None or type(number) is int:
        return number
    if isinstance(number, bool) or getattr(number, "dtype", None) is torch.bool:
        return number
    try:
        return operator.index(number)
    except TypeError:
        return number


def checked_sizes(**sizes: Any) -> list[int]:
    """The image's width and height.

    Args:
        **sizes: by name [px]; NumPy's integers will do.

    Returns:
        The same as Python's integers.

    Raises:
        UserError: naming the argument, what is allowed, and what was given.
    """
    pixels = [as_whole(size) for size in sizes.values()]
    for name, whole in zip(sizes, pixels, strict=True):
        if type(whole) is not int or whole < 1:
            raise UserError(f"{name} must be a positive whole number of pixels, got {_shown(whole)}.")
        if whole > SIZE_MAX:
            raise UserError(f"{name} must be at most {SIZE_MAX:,} pixels, got {_shown(whole)}.")
    return pixels


def checked_limits(**limits: Any) -> dict[str, float]:
    """near_plane, far_plane, radius_clip and eps2d.

    Args:
        **limits: by name; NumPy's numbers will do.

    Returns:
        The same as Python's numbers.

    Raises:
        UserError: naming the argument, what is allowed, and what was given.
    """
    numbers = {}
    for name, value in limits.items():
        try:
            numbers[name] = math.nan if isinstance(value, str) else float(value)
        except (TypeError, ValueError, RuntimeError, OverflowError):  # what torch raises of several numbers
            numbers[name] = math.nan
        if math.isnan(numbers[name]):
            raise UserError(f"{name} must be a number, got {_shown(value)}.")
    if numbers["eps2d"] < 0:
        raise UserError(f"eps2d must be at least 0 px², got {numbers['eps2d']}.")
    return numbers


def _shown(value: Any) -> str:
    """An argument as a message shows it, in one short line."""
    try:
        text = " ".join((value if isinstance(value, str) else repr(value)).split())
    except ValueError:  # of a number with thousands of digits
        text = type(value).__name__
    return text if len(text) <= 80 else f"{text[:77]}..."
