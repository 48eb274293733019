"""What changes while training is all in the checkpoint, and its gradients have names."""

from pathlib import Path

import torch
from toy_run import assert_same_state, flat_tensors, many_frames, state_tensors, toy_run_config, toy_trainer

from thermosplat.checkpoint import load_checkpoint, save_checkpoint
from thermosplat.model import SceneModel
from thermosplat.training.training_state import TrainingState
from toy_scene import toy_capture


def test_round_trip_through_a_file(tmp_path: Path) -> None:
    """Model, moments, sums, step and clock survive a file that torch's safe loader reads."""
    config, capture = toy_run_config(), many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, config, capture)
    for _ in range(4):  # past a refinement, so that the model has another size than at the start
        trainer._train_step()
    save_checkpoint(tmp_path / "x.pt", trainer.state.checkpoint(config, 1, capture.thermal_scale))
    checkpoint = load_checkpoint(tmp_path / "x.pt")
    device = torch.device("cpu")
    restored = TrainingState(SceneModel.from_checkpoint(checkpoint, device), config, capture.scene_extent, device)
    restored.load(checkpoint)
    before = state_tensors(trainer)
    trainer.state = restored
    assert_same_state(state_tensors(trainer), before)
    assert restored.step == 4
    assert restored.seconds.train > 0
    assert checkpoint["sh_degree"] == 1
    assert checkpoint["thermal_scale"]["kind"] == "color"


def test_checkpoint_of_tensors_without_gradients(tmp_path: Path) -> None:
    """Nothing in a checkpoint is a parameter: it is written while another thread renders the model (``meanwhile``)."""
    config, capture = toy_run_config(), many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, config, capture)
    trainer._train_step()
    tensors = flat_tensors(trainer.state.checkpoint(config, 1, capture.thermal_scale)).values()
    assert sum(tensor.numel() for tensor in tensors) > sum(value.numel() for value in trainer.model.parameters())
    assert not any(tensor.requires_grad for tensor in tensors)


def test_gradients_are_named_by_set_and_parameter(tmp_path: Path) -> None:
    """Every parameter with a gradient is listed under its set, the decoders' together, but for colours that are finite
    where others are; clearing forgets them."""
    trainer = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture()))
    state = trainer.state
    assert not any(state.gradients_to_watch().values())
    for parameter in state.model.parameters():
        parameter.grad = torch.ones_like(parameter)
    gradients = state.gradients_to_watch()
    assert {"shared means", "shared thermal_opacity_offsets", "decoders"} <= set(gradients)
    listed = sum(len(tensors) for tensors in gradients.values())
    assert listed == len(list(state.model.parameters())) - 1
    assert "shared sh0" in gradients
    assert "shared shN" not in gradients
    state.clear_gradients()
    assert all(parameter.grad is None for parameter in state.model.parameters())


def test_checkpoints_of_the_first_version_load(tmp_path: Path) -> None:
    """They know nothing of budgets: growth goes on."""
    config, capture = toy_run_config(), many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, config, capture)
    trainer._train_step()
    checkpoint = trainer.state.checkpoint(config, 0, None)
    for key in ("growing", "offsets_dropped", "best_validation", "exposures"):
        del checkpoint["training"][key]
    trainer.state.growing = False
    trainer.state.load(checkpoint)
    assert trainer.state.growing
    assert not trainer.state.offsets_dropped
