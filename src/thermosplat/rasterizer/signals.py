"""What is blended beside the three channels of a colour: spherical harmonics of any number of channels.

The kernels sum three channels at a time. Coefficients of D channels are cut into groups of three, the last of which is
filled up with zeros, and the sums are put together again.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

GROUP = 3
"""Channels that the kernels sum at a time."""

HALF = (torch.float16, torch.bfloat16)
"""Types of 16 bits, which kernels do not read."""


class Signal(NamedTuple):
    """Something to be blended, as a caller gives it."""

    values: Any
    """Values [..., (C,) N, D]; with ``sh_degree`` coefficients [..., (C,) N, K, 3], or a pair of them."""
    sh_degree: int | None
    """Active degree, or None of values."""
    clamped: bool = True
    """Sums of spherical harmonics below 0 become 0, as those of colours do."""


def grouped(name: str, values: Any, sh_degree: int | None, means: Tensor, *, clamped: bool = True) -> dict[str, Signal]:
    """A signal in groups of three channels.

    Args:
        name: Of the argument; a group has its channels behind that.
        values: As the caller gave them, not checked yet. Coefficients may be in two more forms, as in gsplat's main
            branch: with 16 bits, and [N, K, D] for all scenes.
        sh_degree: Active degree; None: values are blended as they are, in one group.
        means: [..., N, 3], whose type and scenes coefficients get.
        clamped: As in ``Signal``.

    Returns:
        The groups in order, by name.
    """
    if sh_degree is None:
        return {name: Signal(values, None, clamped)}
    if isinstance(values, tuple):
        return {name: Signal(tuple(_of_scenes(one, means) for one in values), sh_degree, clamped)}
    dense = isinstance(values, Tensor) and values.layout is torch.strided and values.dim() > 0
    if dense and (values.dtype in HALF or (values.dim() == 3 and getattr(means, "ndim", 0) > 2)):
        values = _of_scenes(values, means)
    channels = values.shape[-1] if dense else GROUP
    if channels in (0, GROUP):
        return {name: Signal(values, sh_degree, clamped)}
    groups = {}
    for first in range(0, channels, GROUP):
        group = values[..., first : first + GROUP]
        filled = pad(group, (0, GROUP - group.shape[-1]))
        groups[f"{name}[..., {first}:{first + group.shape[-1]}]"] = Signal(filled, sh_degree, clamped)
    return groups


def _of_scenes(values: Any, means: Any) -> Any:
    """Coefficients in the type of the means, and of as many scenes."""
    if not isinstance(values, Tensor) or not isinstance(means, Tensor):
        return values
    if values.dtype in HALF:
        values = values.to(means.dtype)
    return values.expand(*means.shape[:-2], *values.shape) if values.dim() == 3 and means.dim() > 2 else values


def rejoined(groups: Sequence[Tensor], values: Any) -> Tensor:
    """The channels of all groups.

    Args:
        groups: Final values of each, [images · N, X].
        values: What ``grouped`` was given.

    Returns:
        [images · N, D].
    """
    joined = groups[0] if len(groups) == 1 else torch.cat(list(groups), -1)
    channels = values.shape[-1] if isinstance(values, Tensor) else GROUP
    return joined if joined.shape[-1] == channels else joined[:, :channels].contiguous()
