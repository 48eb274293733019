"""How fast a trained scene renders."""

import time

import torch

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import FrameTensors, without_pixels
from thermosplat.scene.model import SceneModel

LEAST_SECONDS = 1.0
"""A GPU is timed at least this long [s]."""


@torch.no_grad()
def frames_per_second(model: SceneModel, capture: Capture, *, sh_degree: int, device: torch.device) -> float:
    """Held-out frames rendered a second, each with all modelled spectra, at the size of its images.

    Every frame is rendered once before the clock starts. Nothing is copied back from the device.

    Args:
        model: The scene.
        capture: Its capture; ``capture.test`` is rendered.
        sh_degree: Highest SH degree in use.
        device: Where the model is.
    """
    frames = [
        FrameTensors(f.name, {name: without_pixels(v, device) for name, v in f.views.items()}, f.shared_cameras)
        for f in capture.test
    ]

    def render_all() -> None:
        for frame in frames:
            model.render(frame.views, sh_degree=sh_degree, shared_cameras=frame.shared_cameras)
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    render_all()
    started, rounds, elapsed = time.perf_counter(), 0, 0.0
    while rounds == 0 or (device.type == "cuda" and elapsed < LEAST_SECONDS):
        render_all()
        rounds += 1
        elapsed = time.perf_counter() - started
    return rounds * len(frames) / elapsed
