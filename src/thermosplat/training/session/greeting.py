"""What a training says before its first step."""

import torch

from thermosplat.config import TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.parallax import Seen, parallax_remark, triangulation_angle
from thermosplat.runs.run_directory import RunDirectory


def greeting(
    config: TrainConfig,
    capture: Capture,
    run: RunDirectory,
    device: torch.device,
    *,
    step: int,
    num_frames: int,
    num_gaussians: int,
) -> list[str]:
    """On what is trained, how much of it there is, and where the results go.

    Args:
        config: The training's.
        capture: What is trained on.
        run: Where the results go.
        device: The device of the training.
        step: Steps done.
        num_frames: Frames that are trained on.
        num_gaussians: Gaussians in all sets.

    Returns:
        Lines.
    """
    lines = []
    if device.type == "cpu":
        why = "Training on the CPU" if torch.cuda.is_available() else "No CUDA device: training on the CPU"
        cores = f"{torch.get_num_threads()} torch threads"
        advice = "" if config.config == "demo" else "; --config demo is made for it"
        lines.append(f"{why} with Warp ({cores}), many times slower than a GPU{advice}.")
    lines.append(
        f"{capture.name}: {num_frames} training and {len(capture.test)} held-out frames, "
        f"{num_gaussians:,} Gaussians{f', from step {step:,}' if step else ''}; results go to {run.path}"
    )
    views = (next(iter(frame.views.values())) for frame in capture.train)
    seen = [Seen(view.viewmat, view.camera.K, view.camera.width, view.camera.height) for view in views]
    remark = parallax_remark(triangulation_angle(seen, capture.points))
    return lines if remark is None else [*lines, remark]
