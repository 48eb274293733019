"""The training frames as tensors, kept on the device as far as memory allows."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import FrameTensors, ViewTensors, frame_tensors, packed
from thermosplat.errors import UserError
from thermosplat.refinement.camera_corrections import CameraCorrections

_CACHED_SHARE = 0.25
"""Share of the free memory that frames may fill; Gaussians and the renderer need the rest."""


class TrainFrames:
    """The frames to learn from, in the capture's order, by index.

    Args:
        capture: The capture. Frames without a view that the model renders are left out.
        spectra: Names of the spectra that are modelled; frames hold no others.
        device: Where the tensors go.

    Raises:
        UserError: If no frame is left.
    """

    def __init__(self, capture: Capture, spectra: Collection[str], device: torch.device) -> None:
        self.frames = capture.training_frames(spectra)
        if not self.frames:
            raise UserError(f"{capture.root} has no training frame of a spectrum that is modelled.")
        self.scales = capture.scales
        self.device = device
        self._cache: dict[int, FrameTensors] = {}
        self._budget = _CACHED_SHARE * _free_bytes(device)

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[FrameTensors]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> FrameTensors:
        """Tensors of a frame; made again each time once the memory for them is full."""
        if index in self._cache:
            return self._cache[index]
        place = torch.tensor(index, device=self.device)
        frame = packed(replace(frame_tensors(self.frames[index], self.scales, self.device), index=place))
        size = sum(map(_bytes, frame.views.values()))
        if size <= self._budget:
            self._budget -= size
            self._cache[index] = frame
        return frame


class CorrectedFrames:
    """The training frames with their cameras as they are believed to be now.

    Args:
        frames: The frames as the capture has them.
        corrections: What is wrong with the cameras; None: nothing.
    """

    def __init__(self, frames: TrainFrames, corrections: CameraCorrections | None) -> None:
        self.frames = frames.frames
        self._tensors, self._corrections = frames, corrections

    def __len__(self) -> int:
        return len(self._tensors)

    def __iter__(self) -> Iterator[FrameTensors]:
        return (self[index] for index in range(len(self)))

    @torch.no_grad()
    def __getitem__(self, index: int) -> FrameTensors:
        """Tensors of a frame; through its cameras no gradient reaches the corrections."""
        frame = self._tensors[index]
        return frame if self._corrections is None else self._corrections(frame)


def _bytes(view: ViewTensors) -> int:
    tensors = [value for value in (view.image, view.intensity, view.values) if isinstance(value, Tensor)]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def _free_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):  # with what the file cache would give back
            return int(line.split()[1]) * 1024
    return 0
