"""Training frames with smaller images: averages over the area that a new pixel covers, made once per size.

The averages are exact for every factor, and the same as ``--data-factor`` takes (OpenCV's INTER_AREA), but for the
rounding to 8 bits. Cameras are those that ``--data-factor`` makes. The averages are made where the frames are: on
the device, from the images of full size.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from thermosplat.datasets.capture import View
from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors, packed, readout_tensor, with_unit_images
from thermosplat.datasets.lens import shrunk

if TYPE_CHECKING:
    from thermosplat.training.frames.train_frames import TrainFrames

SHORTEST_SIDE = 32
"""No side of an image becomes shorter [px]: SSIM's window has 11. Open choice."""
_WHOLE = 1.0 - 1e-4
"""Share of a new pixel's area from which on all that it covers counts, but for rounding."""


class ShrunkFrames:
    """The training frames at one size after the other."""

    def __init__(self, frames: "TrainFrames") -> None:
        self._frames = frames
        self.factor = 1.0
        self._kept: dict[int, FrameTensors] = {}

    def at(self, place: int, order: Callable[[int], int], end: int, factor: float) -> FrameTensors:
        """Tensors of the frame at a place of an order, as ``TrainFrames.at``.

        Args:
            factor: What the sides of images are divided by. What was kept of another factor goes.
        """
        if factor != self.factor:
            self._frames.reserve(-sum(frame.num_bytes for frame in self._kept.values()))
            self._kept.clear()
            self.factor = factor
        if factor == 1.0:
            return self._frames.at(place, order, end)
        index = order(place)
        if index in self._kept:
            return self._kept[index]
        full = with_unit_images(self._frames.at(place, order, end))
        frame = shrunk_frame(full, self._frames.frames[index].views, factor)
        if self._frames.from_disk is None and self._frames.reserve(frame.num_bytes):
            self._kept[index] = frame
        return frame


def shrunk_frame(frame: FrameTensors, taken: Mapping[str, View], factor: float) -> FrameTensors:
    """A frame whose images have sides divided by a factor, packed, without measured values.

    Args:
        taken: Its views as the capture has them, by spectrum.
        factor: At least 1.
    """
    views = {name: shrunk_view(view, taken[name], factor) for name, view in frame.views.items()}
    return packed(replace(frame, views=views, memory=None))


def shrunk_view(view: ViewTensors, taken: View, factor: float) -> ViewTensors:
    """A view whose image has sides divided by a factor; no side is made shorter than ``SHORTEST_SIDE``.

    Args:
        factor: At least 1.
    """
    longest = min(view.width, view.height) / SHORTEST_SIDE
    camera = shrunk(taken.camera, max(1.0, min(factor, longest)))
    image, intensity = (
        None if pixels is None else area_averages(pixels, camera.width, camera.height)
        for pixels in (view.image, view.intensity)
    )
    mask = None if view.mask is None else area_averages(view.mask.float(), camera.width, camera.height) > _WHOLE
    K = torch.tensor(camera.K, dtype=view.K.dtype, device=view.K.device)
    readout = None if taken.readout is None else taken.readout.resized(taken.camera, camera)
    return replace(
        view,
        K=K,
        width=camera.width,
        height=camera.height,
        image=image,
        intensity=intensity,
        mask=mask,
        values=None,
        readout=readout_tensor(readout, view.K.device),
    )


def area_averages(pixels: Tensor, width: int, height: int) -> Tensor:
    """Each new pixel is the mean over the area that it covers.

    Args:
        pixels: float32 [H, W] or [H, W, C].
        width: New width, at most W [px].
        height: New height, at most H [px].

    Returns:
        float32 [height, width] or [height, width, C].
    """
    rows, columns = _shares(pixels.shape[0], height, pixels), _shares(pixels.shape[1], width, pixels)
    by_row = torch.tensordot(rows, pixels, dims=1)
    return torch.tensordot(columns, by_row.transpose(0, 1), dims=1).transpose(0, 1).contiguous()


def _shares(length: int, count: int, like: Tensor) -> Tensor:
    """Share of each of ``length`` pixels of a line in each of ``count`` new ones, [count, length]."""
    edges = torch.arange(count + 1, dtype=torch.float64) * (length / count)
    starts = torch.arange(length, dtype=torch.float64)
    ends = torch.minimum(edges[1:, None], starts + 1)
    overlaps = (ends - torch.maximum(edges[:-1, None], starts)).clamp(min=0.0)
    return (overlaps * (count / length)).to(like)
