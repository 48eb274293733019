"""What is blended: values or spherical harmonics, checked and cut into groups, and the channels of an image of them.

The kernels sum three channels of harmonics at a time. Coefficients of D channels are cut into groups of three, the last
of which is filled up with zeros, and the sums are put together again.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from thermosplat.errors import UserError
from thermosplat.rasterizer.arguments import check_backgrounds, check_is_dense, check_shape
from thermosplat.rasterizer.call_inputs import BlendedValues

GROUP = 3
"""Channels that the kernels sum at a time."""

HALF = (torch.float16, torch.bfloat16)
"""Types of 16 bits, which kernels do not read."""


def grouped(
    name: str, values: Any, sh_degree: int | None, means: Tensor, *, clamped: bool = True
) -> dict[str, BlendedValues]:
    """Values in groups of three channels.

    Args:
        name: Of the argument; a group has its channels behind that.
        values: As the caller gave them, not checked yet. Coefficients may be in two more forms, as in gsplat's main
            branch: with 16 bits, and [N, K, D] for all scenes.
        sh_degree: Active degree; None: values are blended as they are, in one group.
        means: [..., N, 3], whose type and scenes coefficients get.
    """
    if sh_degree is None:
        return {name: BlendedValues(values, None, clamped)}
    if isinstance(values, tuple):
        return {name: BlendedValues(tuple(_of_scenes(one, means) for one in values), sh_degree, clamped)}
    dense = isinstance(values, Tensor) and values.layout is torch.strided and values.dim() > 0
    if dense and (values.dtype in HALF or (values.dim() == 3 and getattr(means, "ndim", 0) > 2)):
        values = _of_scenes(values, means)
    channels = values.shape[-1] if dense else GROUP
    if channels in (0, GROUP):
        return {name: BlendedValues(values, sh_degree, clamped)}
    groups = {}
    for first in range(0, channels, GROUP):
        group = values[..., first : first + GROUP]
        filled = pad(group, (0, GROUP - group.shape[-1]))
        groups[f"{name}[..., {first}:{first + group.shape[-1]}]"] = BlendedValues(filled, sh_degree, clamped)
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


def check_values(name: str, values: Any, sh_degree: int | None, means: Tensor, cameras: int) -> bool:
    """Checks what is blended.

    Args:
        means: [..., N, 3].
        cameras: C.

    Returns:
        Whether there are values of their own for each camera.

    Raises:
        UserError: naming the argument, what was expected and what was found.
    """
    if isinstance(values, tuple):
        if len(values) == 2 and sh_degree is not None:
            return _check_pair(name, *values, means, cameras, sh_degree)
        raise UserError(f"{name} must be a torch.Tensor, got {type(values).__name__}.")
    check_is_dense(name, values)
    shape, lead, tail = values.shape, tuple(means.shape[:-1]), 1 if sh_degree is None else 2
    per_camera = len(shape) == len(lead) + 1 + tail
    if per_camera:
        lead = (*lead[:-1], cameras, lead[-1])
    if len(shape) != len(lead) + tail or shape[: len(lead)] != lead:
        letters = "[..., (C,) N, D]" if sh_degree is None else "[..., (C,) N, K, 3]"
        expected = f"{letters} with N = {means.shape[-2]} (from means) and C = {cameras} (from viewmats)"
        mode = "without sh_degree" if sh_degree is None else f"with sh_degree={sh_degree}"
        raise UserError(f"{name} {mode} must have shape {expected}, got {list(shape)}.")
    check_shape(name, values, shape, means)
    if shape[-1] < 1:
        raise UserError(f"{name} must have at least one channel, got {list(shape)}.")
    if sh_degree is not None and (shape[-1] != 3 or shape[-2] < (sh_degree + 1) ** 2):
        raise UserError(
            f"{name} must hold at least {(sh_degree + 1) ** 2} coefficients of 3 channels for sh_degree={sh_degree} "
            f"([..., (C,) N, K, 3]), got {list(shape)}."
        )
    return per_camera


def _check_pair(name: str, sh0: Tensor, shN: Tensor, means: Tensor, cameras: int, sh_degree: int) -> bool:
    """``check_values`` of coefficients in two tensors."""
    per_camera = check_values(f"{name}[0]", sh0, 0, means, cameras)
    check_shape(f"{name}[0]", sh0, (*sh0.shape[:-2], 1, 3), means)
    needed = (sh_degree + 1) ** 2 - 1
    given = shN.shape[-2] if isinstance(shN, Tensor) and shN.dim() > 1 else 0
    check_shape(f"{name}[1]", shN, (*sh0.shape[:-2], max(given, needed), 3), means)
    return per_camera


class ImageColumns(NamedTuple):
    """What is blended in one image, each [images · N, X]; None where there is no such thing."""

    colors: Tensor | None
    extras: Tensor | None
    depths: Tensor | None
    weights: Tensor | None
    """Ones: their image is the sum of weights that expected depths are divided by. 1 - T loses its digits where little
    is drawn. With distances along rays alone they are what there is to blend."""

    @property
    def features(self) -> Tensor:
        """All channels side by side, [images · N, channels]."""
        columns = [column for column in self if column is not None]
        return columns[0] if len(columns) == 1 else torch.cat(columns, -1)

    def behind(self, backgrounds: Tensor, means: Tensor, cameras: int, given_channels: int) -> Tensor | None:
        """What is behind all channels. Depth has no background, as in gsplat.

        Args:
            backgrounds: [..., C, D] behind the colours, or [..., C, D + E] behind the extra signals too.
            means: [..., N, 3].
            cameras: C.
            given_channels: D of the colours that the caller gave, whether they are drawn or not.

        Returns:
            [..., C, channels]; None where nothing is behind anything.

        Raises:
            UserError: they have the wrong shape, or are not finite.
        """
        both = given_channels + _width(self.extras)
        wide = isinstance(backgrounds, Tensor) and backgrounds.shape[-1:] == (both,)
        check_backgrounds(backgrounds, both if wide else given_channels, means, cameras)
        of_colors, of_extras = backgrounds[..., :given_channels], backgrounds[..., given_channels:]
        channels = sum(_width(column) for column in self)
        kept = [one for one, shown in ((of_colors, self.colors), (of_extras, self.extras)) if shown is not None]
        filled = sum(one.shape[-1] for one in kept)
        if filled == 0:
            return None
        if filled == channels:
            return backgrounds
        return torch.cat([*kept, backgrounds.new_zeros(*backgrounds.shape[:-1], channels - filled)], -1)

    def split_image(self, image: Tensor, *, expected: bool, hits: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """The image of colours and depth, and that of the extra signals.

        Args:
            image: [..., C, H, W, channels].
            expected: Depths are divided by the sum of their weights.
            hits: Sums of distances along rays, [..., C, H, W, 1], in the place of the depths; None: there are none.

        Returns:
            [..., C, H, W, D + 1 or less] and [..., C, H, W, E] or None.
        """
        if self.extras is None and self.weights is None and hits is None:
            return image, None
        sizes = [_width(column) for column in self]
        colors, extras, depths, weights = image.split(sizes, -1)
        depths = depths if hits is None else hits
        if expected:
            depths = depths / weights.clamp(min=1e-10)
        return torch.cat([colors, depths], -1), None if self.extras is None else extras


def _width(column: Tensor | None) -> int:
    return 0 if column is None else column.shape[-1]
