"""What changes while training is all in the checkpoint, and its gradients have names."""

import dataclasses
from pathlib import Path

import torch

from thermosplat.runs.checkpoint import Checkpoint
from thermosplat.runs.checkpoint_file import load_checkpoint, save_checkpoint
from thermosplat.scene.model import SceneModel
from thermosplat.training.density.strategies import STRATEGIES
from thermosplat.training.optimizers import gradients_to_watch
from thermosplat.training.training_state import TrainingState
from toy_run import assert_same_state, flat_tensors, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture


def test_round_trip_through_a_file(tmp_path: Path) -> None:
    """Model, moments, sums, step and clock survive a file that torch's safe loader reads."""
    config, capture = toy_run_config(), many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, config, capture)
    for _ in range(4):  # past a refinement, so that the model has another size than at the start
        trainer.train_step()
    save_checkpoint(tmp_path / "x.pt", trainer.state.checkpoint(config, 1, capture.scales).state())
    checkpoint = load_checkpoint(tmp_path / "x.pt")
    device = torch.device("cpu")
    restored = TrainingState(SceneModel.from_checkpoint(checkpoint, device), config, capture, device)
    restored.load(checkpoint)
    before = state_tensors(trainer)
    trainer.state = restored
    assert_same_state(state_tensors(trainer), before)
    assert restored.step == 4
    assert restored.seconds.train > 0
    assert checkpoint.sh_degree == 1
    assert {name: scale["kind"] for name, scale in checkpoint.scales.items()} == {
        "rgb": "photograph",
        "thermal": "color",
    }


def test_checkpoint_of_tensors_without_gradients(tmp_path: Path) -> None:
    """Nothing in a checkpoint is a parameter: it is written while another thread renders the model (``meanwhile``)."""
    config, capture = toy_run_config(), many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, config, capture)
    trainer.train_step()
    tensors = flat_tensors(trainer.state.checkpoint(config, 1, capture.scales).state()).values()
    assert sum(tensor.numel() for tensor in tensors) > sum(value.numel() for value in trainer.model.parameters())
    assert not any(tensor.requires_grad for tensor in tensors)


def test_gradients_are_named_by_set_and_parameter(tmp_path: Path) -> None:
    """Every parameter with a gradient is listed under its set, the decoders' together, but for colours that are finite
    where others are; clearing forgets them."""
    trainer = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture()))
    state = trainer.state
    assert not any(gradients_to_watch(state.optimizers).values())
    for parameter in state.model.parameters():
        parameter.grad = torch.ones_like(parameter)
    gradients = gradients_to_watch(state.optimizers)
    assert {"shared means", "shared thermal_opacity_offsets", "decoders"} <= set(gradients)
    listed = sum(len(tensors) for tensors in gradients.values())
    assert listed == len(list(state.model.parameters())) - 1
    assert "shared sh0" in gradients
    assert "shared shN" not in gradients
    state.clear_gradients()
    assert all(parameter.grad is None for parameter in state.model.parameters())


def test_gradients_of_a_third_spectrum_are_watched(tmp_path: Path) -> None:
    """Its opacities and colours too, but for harmonics above degree 0."""
    config = toy_run_config(model={"feature_dim": 0}, spectra={"nir": {"opacity": "own"}})
    state = toy_trainer(tmp_path, config, many_frames(toy_capture(others=("nir",)))).state
    for parameter in state.model.parameters():
        parameter.grad = torch.ones_like(parameter)
    gradients = set(gradients_to_watch(state.optimizers))
    assert {"shared logit_nir_opacities", "shared nir_sh0", "shared thermal_sh0"} < gradients
    assert not gradients & {"shared shN", "shared thermal_shN", "shared nir_shN"}


def test_each_set_is_controlled_for_its_own_spectra(tmp_path: Path) -> None:
    """A shared set has all spectra in order, a separate one its own; every set has a strategy of the kind asked for."""
    capture = many_frames(toy_capture(others=("nir",)))
    separate = {"gaussian_sets": "separate", "feature_dim": 0}
    for number, (model, expected) in enumerate(
        [
            ({}, {"shared": ("rgb", "thermal", "nir")}),
            (separate, {"rgb": ("rgb",), "thermal": ("thermal",), "nir": ("nir",)}),
        ]
    ):
        for name, kind in STRATEGIES.items():
            if name == "decomposing":  # of two spectra
                continue
            config = toy_run_config(model=model, spectra={"nir": {"opacity": "offset"}})
            config = dataclasses.replace(config, densification=dataclasses.replace(config.densification, strategy=name))
            state = toy_trainer(tmp_path / f"{number}{name}", config, capture).state
            assert {owner: strategy.spectra for owner, strategy in state.strategies.items()} == expected
            assert all(type(strategy) is kind for strategy in state.strategies.values())


def test_checkpoints_of_the_first_version_load(tmp_path: Path) -> None:
    """They know nothing of budgets: growth goes on."""
    config, capture = toy_run_config(), many_frames(toy_capture())
    trainer = toy_trainer(tmp_path, config, capture)
    trainer.train_step()
    state = trainer.state.checkpoint(config, 0, {}).state()
    for key in ("noisy", "growing", "offsets_dropped", "trimmed", "corrections", "best_validation"):
        del state["training"][key]
    for key in ("train_frames", "test_frames"):
        del state[key]
    checkpoint = Checkpoint.from_state(state, tmp_path)
    assert checkpoint.train_frames is None
    trainer.state.budget.growing = False
    trainer.state.load(checkpoint)
    assert trainer.state.budget.growing
    assert not trainer.state.budget.offsets_dropped
