"""What differs between the training images of one scene though the scene does not: exposure and gain of each view.

Every training frame has an affine map of colours for either spectrum, C' = A C + b, which stands between the render and
the losses. Held-out views have none, so only differences between views can be told: the maps' mean over all frames is
kept at the identity. 3DGS learns such maps for RGB (exposure compensation); thermal cameras change their gain likewise.
"""

from dataclasses import replace

import torch
from torch import Tensor, nn

from thermosplat.rendered_frame import RenderedFrame


class Exposures(nn.Module):
    """Affine colour changes by training frame, as deviations from the identity.

    Attributes:
        rgb: [A - I | b] of RGB images, shape [F, 3, 4].
        thermal: The same of thermal images, shape [F, C, C + 1] with C thermal channels: gain and level of a scalar.

    Args:
        num_frames: Training frames F.
        thermal_channels: 3 for pseudo-coloured thermal images, 1 for normalised radiometric ones, 0 for none.
    """

    def __init__(self, num_frames: int, thermal_channels: int) -> None:
        super().__init__()
        self.rgb = nn.Parameter(torch.zeros(num_frames, 3, 4))
        self.thermal = nn.Parameter(torch.zeros(num_frames, thermal_channels, thermal_channels + 1))

    def forward(self, rendered: RenderedFrame, index: Tensor) -> RenderedFrame:
        """A render as the camera of one training frame took it.

        The features that are compared with the same image (A_f[:3], and A_ft[3] with a scalar one) change with it.

        Args:
            rendered: The render.
            index: The frame, int64 scalar on the device.
        """
        rgb, thermal = (_of_frame(maps, index) for maps in (self.rgb, self.thermal))
        changed = replace(rendered)
        if rendered.rgb is not None:
            changed.rgb = _affine(rendered.rgb, rgb)
            if rendered.visible_features is not None:
                changed.visible_features = _affine_channels(rendered.visible_features, 0, 3, rgb)
        if rendered.thermal is not None:
            changed.thermal = _affine(rendered.thermal, thermal)
            if rendered.thermal_features is not None and self.thermal.shape[1] == 1:
                changed.thermal_features = _affine_channels(rendered.thermal_features, 3, 4, thermal)
        return changed


def _of_frame(maps: Tensor, index: Tensor) -> Tensor:
    """A frame's map less the mean of all frames' [C, C + 1]. No value is read back: the index stays on the device."""
    return maps.index_select(0, index.reshape(1))[0] - maps.mean(dim=0)


def _affine(image: Tensor, change: Tensor) -> Tensor:
    """Image [H, W, C] changed by [A - I | b]."""
    return image + image @ change[:, :-1].T + change[:, -1]


def _affine_channels(features: Tensor, start: int, stop: int, change: Tensor) -> Tensor:
    changed = _affine(features[..., start:stop], change)
    return torch.cat([features[..., :start], changed, features[..., stop:]], dim=-1)
