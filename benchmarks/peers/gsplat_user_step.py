"""A training step as a user of gsplat would write it: our model and losses in eager PyTorch, on two of its calls."""

import copy
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from itertools import cycle

import torch
from torch import Tensor

from measuring.timing import wait
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.losses.image_terms import compare_frame
from thermosplat.training.optimizers import EPSILON
from thermosplat.training.trainer import Trainer


class GsplatUserStep:
    """Steps without a graph: decoders in float32, kornia's losses, torch's fused Adam for each parameter.

    No density control, no logging, no look at what is not finite. The rates are 0, as in frozen trainers.

    Args:
        source: A frozen trainer: its model is copied, its frames are used.
        swapped: Opened around rendering: puts gsplat's rasterizer in place of ours.
    """

    def __init__(self, source: Trainer, swapped: Callable[[], AbstractContextManager[None]]) -> None:
        self.model = copy.deepcopy(source.model)
        self.config = source.device_step.config  # with the smoothness that was measured
        self.device = source.device
        self.swapped = swapped
        self.frames = [source.frames[index] for index in range(len(source.frames))]
        self._order = cycle(self.frames)
        parameters = [parameter for parameter in self.model.parameters() if parameter.numel() > 0]
        self.optimizers = [torch.optim.Adam([parameter], lr=0.0, eps=EPSILON, fused=True) for parameter in parameters]

    def losses(self, frame: FrameTensors) -> dict[str, Tensor]:
        """Weighted loss terms of a frame."""
        with self.swapped():
            rendered = self.model.render(
                frame.views, sh_degree=self.config.sh_degree, shared_cameras=frame.shared_cameras
            )
            return compare_frame(rendered, frame, self.config, fused=False).losses

    def loss_values(self) -> dict[str, float]:
        """Loss terms of the first frame."""
        with torch.no_grad():
            return {name: float(loss) for name, loss in self.losses(self.frames[0]).items()}

    def run(self, count: int) -> float:
        """Does so many steps; seconds until the device has done them."""
        wait(self.device)
        started = time.perf_counter()
        for _ in range(count):
            torch.stack(list(self.losses(next(self._order)).values())).sum().backward()
            for optimizer in self.optimizers:
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
        wait(self.device)
        return time.perf_counter() - started
