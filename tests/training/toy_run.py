"""Short training runs on a toy capture of several frames."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch

from thermosplat.config import DensificationConfig, TrainConfig
from thermosplat.datasets.capture import Capture, Frame, View
from thermosplat.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer
from toy_scene import toy_config


def many_frames(capture: Capture, count: int = 5) -> Capture:
    """The toy capture's frame seen from several places, each with images of its own; one frame is held out."""
    frame = capture.train[0]

    def moved(view: View | None, index: int) -> View | None:
        if view is None:
            return None
        viewmat = view.viewmat.copy()
        viewmat[0, 3] += 0.3 * (index - count / 2)
        image = np.ascontiguousarray(np.roll(view.image, index, axis=1))
        return dataclasses.replace(view, name=f"view{index}", viewmat=viewmat, image=image)

    frames = tuple(Frame(f"frame{i}", moved(frame.rgb, i), moved(frame.thermal, i)) for i in range(count))
    return dataclasses.replace(capture, train=frames[1:], test=frames[:1])


def toy_run_config(max_steps: int = 12, *, model: dict[str, Any] | None = None, **changes: Any) -> TrainConfig:
    """Twelve steps with refinements at 3, 6, 9 and 12 and resets at 5 and 10."""
    densification = DensificationConfig(
        start_step=2,
        stop_step=50,
        every=3,
        reset_every=5,
        grad_threshold=1e-4,
        max_gaussians=600,
        grow_scale3d=0.8,
        prune_scale3d=1.5,
    )
    settings: dict[str, Any] = {
        "max_steps": max_steps,
        "sh_degree_interval": 4,
        "device": "cpu",
        "eval_steps": (),
        "save_steps": (),
        "log_every": 5,
        "tensorboard": False,
        "densification": densification,
    }
    return dataclasses.replace(toy_config(decoder={"hidden_dim": 8}, **(model or {})), **{**settings, **changes})


def toy_trainer(path: Path, config: TrainConfig, capture: Capture) -> Trainer:
    """A trainer of a new run."""
    return Trainer(config, capture, RunDirectory.create(path))


def state_tensors(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Copies of everything that a checkpoint holds of the training but the clock, as one flat dictionary of tensors."""
    state = trainer.state.checkpoint(trainer.config, 0, None)
    held = flat_tensors({"model": state["model"], **state["training"]})
    return {name: tensor.detach().clone() for name, tensor in held.items()}


def flat_tensors(value: Any, name: str = "") -> dict[str, torch.Tensor]:
    """The tensors in nested dictionaries by the keys that lead to them; anything else is left out."""
    if isinstance(value, torch.Tensor):
        return {name: value}
    flat: dict[str, torch.Tensor] = {}
    if isinstance(value, dict):
        for key, item in value.items():
            flat |= flat_tensors(item, f"{name}.{key}")
    return flat


def assert_same_state(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    """Two states are equal to the last bit."""
    assert one.keys() == other.keys()
    different = [name for name in one if not torch.equal(one[name], other[name])]
    assert not different
