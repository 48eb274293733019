"""Launches on images: left out of what is recorded, and made by each replay on images of the caller's own.

So nobody copies images, nor their gradients, from fixed memory or to it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from thermosplat.torch_bridge.streams import launches_on_torch_stream
from warp_kernels.blending.blended_arrays import BlendedArrays
from warp_kernels.machinery.array_views import ArrayView


@dataclass
class Places:
    """Where the images of the next replay lie, and then their gradients: addresses, None for the fixed memory."""

    images: list[int | None] = field(default_factory=lambda: [None] * 4)
    """In the order of ``images_drawn``; see ``BlendLauncher.forward``."""
    gradients: list[int | None] = field(default_factory=lambda: [None] * 5)
    """To parts of them; see ``BlendLauncher.backward``."""


class LaunchedNow:
    """A ``BlendLauncher`` that does what it is told of, and remembers what was written."""

    def __init__(self) -> None:
        self.blended: list[BlendedArrays] = []

    def forward(self, launch: Callable[[], None], blended: BlendedArrays) -> None:
        """Launches."""
        self.blended.append(blended)
        launch()

    def backward(self, launch: Callable[[], None], v_images: tuple[ArrayView | None, ...]) -> None:
        """Launches."""
        launch()


class LaunchedByReplays(LaunchedNow):
    """A ``BlendLauncher`` whose launches are left out of what is recorded, and made by each replay on its images.

    Args:
        leave_out: Keeps what each replay has to do there.
    """

    def __init__(self, device: torch.device, leave_out: Callable[[Callable[[], None]], None], places: Places) -> None:
        super().__init__()
        self._device, self._leave_out, self._places = device, leave_out, places
        self.read: tuple[int | None, ...] = ()

    def forward(self, launch: Callable[[], None], blended: BlendedArrays) -> None:
        """Leaves a launch to the replays."""
        self.blended.append(blended)
        self._leave(launch, images_drawn(blended), self._places.images)

    def backward(self, launch: Callable[[], None], v_images: tuple[ArrayView | None, ...]) -> None:
        """Leaves a launch to the replays, and remembers where it reads."""
        self.read = tuple(None if one is None else one.ptr for one in v_images)
        self._leave(launch, v_images, self._places.gradients)

    def _leave(
        self, launch: Callable[[], None], arrays: Sequence[ArrayView | None], places: Sequence[int | None]
    ) -> None:
        fixed = [(array, array.ptr, k) for k, array in enumerate(arrays) if array is not None]
        device = self._device

        def launch_there() -> None:
            for array, home, k in fixed:
                place = places[k]
                array.place(home if place is None else place)
            with launches_on_torch_stream(device):
                launch()

        self._leave_out(launch_there)


RENDERS = 2
"""So many of ``images_drawn`` nobody reads again; the adjoint reads the others."""


def images_drawn(blended: BlendedArrays) -> tuple[ArrayView | None, ...]:
    """The images that ``Places.images`` are of, in its order: renders and alphas, of which there may be one each."""
    return blended.render, blended.thermal_render, blended.alphas, blended.thermal_alphas
