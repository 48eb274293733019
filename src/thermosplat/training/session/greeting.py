"""What a training says before its first step."""

from collections.abc import Sequence

import torch

from thermosplat.datasets.parallax import parallax_remark, seen_first, triangulation_angle
from thermosplat.training.session.training_parts import Training


def greeting(training: Training, notes: Sequence[str]) -> list[str]:
    """On what is trained, how much of it there is, and where the results go."""
    config, capture, state, team = training.config, training.capture, training.state, training.team
    lines = list(notes)
    if not team.is_alone:
        lines.insert(0, f"The Gaussians are divided over {team.size} devices, {config.batch_size} frames per step.")
    if team.device.type == "cpu":
        why = "Training on the CPU" if torch.cuda.is_available() else "No CUDA device: training on the CPU"
        cores = f"{torch.get_num_threads()} torch threads"
        advice = "" if config.config == "demo" else "; --config demo is made for it"
        lines.append(f"{why} with Warp ({cores}), many times slower than a GPU{advice}.")
    since = f", from step {state.step:,}" if state.step else ""
    lines.append(
        f"{capture.name}: {len(training.frames)} training and {len(capture.test)} held-out frames, "
        f"{training.state.all_gaussians:,} Gaussians{since}; results go to {training.run.path}"
    )
    remark = parallax_remark(triangulation_angle(seen_first(capture.train), capture.points))
    return lines if remark is None else [*lines, remark]
