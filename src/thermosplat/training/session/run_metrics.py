"""What metrics.json says of a run beside the numbers of its held-out views."""

from typing import Any

import torch

from thermosplat.config import TrainConfig
from thermosplat.image_quality.lpips import Lpips
from thermosplat.refinement.camera_report import correction_summary
from thermosplat.runs.devices import device_name
from thermosplat.scene.initial_gaussians import SHARED
from thermosplat.scene.model import SceneModel
from thermosplat.training.training_state import TrainingState


def run_metrics(
    evaluated: dict[str, Any], state: TrainingState, device: torch.device, lpips: Lpips | None, config: TrainConfig
) -> dict[str, Any]:
    """The content of metrics.json.

    Args:
        evaluated: What ``held_out.evaluate`` returned.
    """
    seconds, model = state.seconds, state.model
    beside: dict[str, Any] = {name: evaluated[name] for name in ("training_views", "remarks") if name in evaluated}
    evaluated = {name: value for name, value in evaluated.items() if name not in beside}
    corrections = state.corrections
    return {
        **evaluated,
        **({} if corrections is None else {"refined": correction_summary(corrections)}),
        "steps": state.step,
        "train_seconds": seconds.train,
        "device": device_name(device),
        "scenes": config.scenes,
        "lens": config.lens,
        "wall_seconds": seconds.wall,
        "first_step_seconds": seconds.first_step,
        "gaussians": {name: len(gaussians) for name, gaussians in state.gaussian_sets.items()},
        "lpips_net": lpips.name if lpips is not None else None,
        "model_bytes": model.num_bytes,
        "feature_channels": feature_channels(model),
        "opacity_offsets_kept": offsets_kept(model),
        "formations": {name: dict(model.formations[name].numbers()) for name in model.spectra},
        **beside,
    }


def feature_channels(model: SceneModel) -> int | None:
    """Latent channels that are blended; None where there are no features."""
    return model.gaussians(SHARED).features.shape[1] if model.has_features else None


def offsets_kept(model: SceneModel) -> dict[str, float]:
    """By spectrum with opacity offsets, the share of the Gaussians whose offset is not zero."""
    kept = {}
    for name in model.gaussian_sets:
        gaussians = model.gaussians(name)
        for spectrum in gaussians.second_opacities:
            values, is_offset = gaussians.stored_opacity(spectrum)
            if values is not None and is_offset:
                kept[spectrum] = (values != 0).float().mean().item()
    return kept
