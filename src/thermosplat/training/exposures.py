"""What differs between the training images of one scene though the scene does not: exposure and gain of each view.

Every training frame has an affine map of colours for each spectrum that asks for one (``SpectrumConfig.exposure``),
C' = A C + b, which stands between the render and the losses. Held-out views have none, so only differences between
views can be told: the maps' mean over all frames is kept at the identity, and with it the scene's own level. 3DGS
learns such maps for RGB (exposure compensation). Uncooled thermal cameras drift in level, and some in gain.
"""

from collections.abc import Collection
from dataclasses import replace

import torch
from torch import Tensor, nn

from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import Spectrum


class Exposures(nn.Module):
    """Affine colour changes by training frame, as deviations from the identity.

    Attributes:
        maps: By spectrum, [A - I | b] of its images, shape [F, C, C + 1] with C channels: gain and level of a scalar.
            Where the level alone differs b, shape [F, C, 1].

    Args:
        num_frames: Training frames F.
        spectra: The spectra of the model that have exposures.
        levels: Names of those whose level alone differs.
    """

    def __init__(self, num_frames: int, spectra: Collection[Spectrum], levels: Collection[str] = ()) -> None:
        super().__init__()
        self.maps = nn.ParameterDict()
        for spectrum in spectra:
            columns = 1 if spectrum.name in levels else spectrum.channels + 1
            self.maps[spectrum.name] = nn.Parameter(torch.zeros(num_frames, spectrum.channels, columns))
        self._latent = {spectrum.name: spectrum.latent for spectrum in spectra}

    def forward(self, rendered: RenderedFrame, index: Tensor) -> RenderedFrame:
        """A render as the camera of one training frame took it.

        The features that are compared with the same image change with it: those of photographs and scalars.

        Args:
            rendered: The render.
            index: The frame, int64 scalar on the device.
        """
        changed = replace(rendered, images=dict(rendered.images), features=dict(rendered.features))
        for name, image in rendered.images.items():
            if name not in self.maps:
                continue
            change = _of_frame(self.maps[name], index)
            changed.images[name] = _affine(image, change)
            first, beyond = self._latent[name]
            if name in rendered.features and beyond - first == image.shape[-1]:
                changed.features[name] = _affine_channels(rendered.features[name], first, beyond, change)
        return changed


def _of_frame(maps: Tensor, index: Tensor) -> Tensor:
    """A frame's map less the mean of all frames'. No value is read back: the index stays on the device."""
    return maps.index_select(0, index.reshape(1))[0] - maps.mean(dim=0)


def _affine(image: Tensor, change: Tensor) -> Tensor:
    """Image [H, W, C] changed by [A - I | b], or by b alone."""
    if change.shape[1] > 1:
        image = image + image @ change[:, :-1].T
    return image + change[:, -1]


def _affine_channels(features: Tensor, start: int, stop: int, change: Tensor) -> Tensor:
    changed = _affine(features[..., start:stop], change)
    return torch.cat([features[..., :start], changed, features[..., stop:]], dim=-1)
