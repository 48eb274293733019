"""Steps of the fit: render the splats and the model, compare, and improve the splats.

A step launches some hundreds of small kernels, which takes Python longer than running them takes a GPU. So on CUDA a
step is captured once for each size of images and replayed from then on (``training.recorded_steps`` does the same).
Cameras are copied into tensors that stay; splats and rates are changed in place.
"""

import dataclasses

import torch

from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.export.splat_fit.exact_images import ExactImages
from thermosplat.export.splat_fit.learning_splats import LearningSplats
from thermosplat.rasterizer.pair_capacity import PairCapacity
from thermosplat.stop_signals import deferred_interrupts
from thermosplat.torch_bridge.streams import captured_in

MEASURED = 16
"""Steps that run line by line at first, to see how many (Gaussian, tile) pairs the images have."""
LOOK_EVERY = 100
"""Steps between two looks whether all pairs had room: a look waits for the device."""

_Size = tuple[int, int]


class FitSteps:
    """Runs the steps of one fit.

    Attributes:
        captures: Whether steps are captured, and replayed from then on.
        capacity: Counts the renderer's pairs.
        graphs: What was captured, by the size of the image.
    """

    def __init__(self, learning: LearningSplats, exact: ExactImages) -> None:
        self.learning, self.exact = learning, exact
        device = exact.background.device
        self.capacity = PairCapacity(device)
        self.captures = device.type == "cuda"
        self._done = 0
        self._cameras: dict[_Size, ViewTensors] = {}
        self.graphs: dict[_Size, torch.cuda.CUDAGraph] = {}
        self._pool: torch.cuda.MemPool | None = None  # outlives the graphs, which take turns in it

    def run(self, view: ViewTensors, share: float) -> None:
        """Do one step.

        Args:
            share: Of the first step sizes, to be taken now.
        """
        self.learning.set_rates(share)
        size = view.width, view.height
        if not self.captures or self._done < MEASURED or size not in self._cameras:
            # the first also load kernels and make Adam's moments, none of which can be captured
            self._cameras.setdefault(size, _copy(view))
            self._step(view, fixed_room=False)
        else:
            if size not in self.graphs:
                with deferred_interrupts():  # a capture does not stay half done
                    self.graphs[size] = self._captured(self._cameras[size])
            self._cameras[size].viewmat.copy_(view.viewmat)
            self._cameras[size].K.copy_(view.K)
            self.graphs[size].replay()
        self._done += 1
        if self.graphs and self._done % LOOK_EVERY == 0 and self.capacity.is_short():
            self.graphs.clear()

    def _captured(self, camera: ViewTensors) -> torch.cuda.CUDAGraph:
        if not self.graphs:
            self.capacity.measure()
        if self._pool is None:
            self._pool = torch.cuda.MemPool()
        graph = torch.cuda.CUDAGraph()
        with captured_in(graph, self._pool.id):
            self._step(camera, fixed_room=True)
        return graph

    def _step(self, view: ViewTensors, *, fixed_room: bool) -> None:
        """Improve the splats, unless pairs found no room.

        Args:
            fixed_room: Render without reading numbers of pairs back.
        """
        adam = self.learning.adam
        with self.capacity.step(fixed=fixed_room):
            image, wanted = self.exact.render(self.learning.splats, view), self.exact.image(view)
        shown = torch.where(wanted == 1.0, image.clamp(max=1.0), image)  # brighter than white is white
        with torch.autograd.set_multithreading_enabled(False):
            (shown - wanted).square().mean().backward()
        adam.found_inf = self.capacity.overflow  # type: ignore[attr-defined]  # as torch.amp.GradScaler tells it
        adam.step()
        adam.zero_grad()


def _copy(view: ViewTensors) -> ViewTensors:
    """A camera in tensors of its own."""
    return dataclasses.replace(view, viewmat=view.viewmat.clone(), K=view.K.clone())
