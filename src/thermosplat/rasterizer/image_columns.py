"""The channels of one image: colours, extra signals, depth; how they lie side by side, and how they are taken apart."""

from typing import NamedTuple

import torch
from torch import Tensor

from thermosplat.rasterizer.arguments import check_backgrounds


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
