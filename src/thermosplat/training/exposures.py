"""What differs between the training images of one scene though the scene does not: exposure and gain of each view.

Every training frame has an affine map of colours for each spectrum that asks for one (``SpectrumConfig.exposure``),
C' = A C + b, which stands between the render and the losses. Held-out views have none, so only differences between
views can be told: the maps' mean over all frames is kept at the identity, and with it the scene's own level. 3DGS
learns such maps for RGB (exposure compensation). Uncooled thermal cameras drift in level, and some in gain.

What a frame's map lacks is a linear least squares problem in the pixels of that frame, so each step solves it, and the
map follows by a share. Adam, which 3DGS takes, moves a frame's map by its rate whatever the difference is, and more by
the root of the number of frames, since it sees a gradient once in so many steps: on the capture room levels wandered by
0.5 K where neighbouring images say 0.16 K (benchmarks/records/real-captures.md).
"""

from collections.abc import Collection
from dataclasses import replace

import torch
from torch import Tensor, nn

from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.spectra import Spectrum

FROM = 0.3
"""Share of the steps before maps change: as long as there is no scene, its errors look like exposures. Open choice."""
SHARE = 0.2
"""Share of what a map lacks that a step adds to it. Open choice: what one step sees of a scene that changes is averaged
over the last five times that the frame was seen."""
_RIDGE = 1e-4
"""Added to the mean squares of the colours, so that an image of one colour has a solution [range of the images²]."""


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
            self.maps[spectrum.name] = nn.Parameter(torch.zeros(num_frames, spectrum.channels, columns), False)
        self._latent = {spectrum.name: spectrum.latent for spectrum in spectra}

    def forward(self, rendered: RenderedFrame, index: Tensor) -> RenderedFrame:
        """A render as the camera of one training frame took it.

        The features that are compared with the same image change with it: those of photographs and scalars.

        Args:
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

    @torch.no_grad()
    def compare(self, rendered: RenderedFrame, frame: FrameTensors) -> None:
        """Note as the maps' gradients what those of one training frame lack. Nothing here waits for the device.

        Args:
            frame: The frame, with its index among all.
        """
        for name, maps in self.maps.items():
            view, image = frame.views.get(name), rendered.images.get(name)
            if view is None or view.image is None or image is None or frame.index is None:
                continue
            lacking = view.image - _affine(image, _of_frame(maps, frame.index))
            counts = torch.ones_like(image[..., :1]) if view.mask is None else view.mask[..., None].to(image.dtype)
            found = _solved(image, lacking, counts, level=maps.shape[-1] == 1)
            if maps.grad is None:
                maps.grad = torch.zeros_like(maps)
            maps.grad.index_add_(0, frame.index.reshape(1), found[None])

    @torch.no_grad()
    def follow(self, blocked: Tensor) -> None:
        """Move the maps by a share of what they lack.

        Args:
            blocked: Scalar on the device; 1 leaves them as they are.
        """
        for maps in self.maps.values():
            if maps.grad is not None:
                maps += (SHARE * (1.0 - blocked)) * maps.grad.nan_to_num(0.0, 0.0, 0.0)


def _solved(image: Tensor, lacking: Tensor, counts: Tensor, *, level: bool) -> Tensor:
    """[A | b], shape [C, C + 1], with A C + b nearest to what is lacking, by least squares; b alone, shape [C, 1].

    Args:
        image: [H, W, C].
        lacking: [H, W, C].
        counts: [H, W, 1], 1 for pixels that count and 0 for others.
        level: Only b.
    """
    number = counts.sum().clamp(min=1.0)
    if level:
        return (counts * lacking).sum(dim=(0, 1))[:, None] / number
    pixels = (counts * torch.cat([image, torch.ones_like(counts)], dim=-1)).flatten(0, 1)
    normal = pixels.T @ pixels / number
    normal.diagonal().add_(_RIDGE)
    rows = torch.cat([normal, pixels.T @ lacking.flatten(0, 1) / number], dim=1)
    # Gauss-Jordan elimination, which needs no pivots here: the matrix is positive definite
    for k in range(len(rows)):
        pivot = rows[k : k + 1] / rows[k, k]
        rows = rows - rows[:, k : k + 1] * pivot
        rows = torch.cat([rows[:k], pivot, rows[k + 1 :]])
    return rows[:, len(rows) :].T


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
