"""Steps that run out of memory begin again with fewer moments on the device."""

from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.training import new_scenes
from thermosplat.training.offloading import Decision
from thermosplat.training.trainer import Trainer
from thermosplat.training.training_step import Differentiated
from toy_run import many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture


def trainer_of(path: Path, said: list[str]) -> Trainer:
    """A trainer that has moments of 40 of its 60 Gaussians on the device."""
    trainer = toy_trainer(path, toy_run_config(offload="on"), many_frames(toy_capture()))
    for optimizer in trainer.state.row_optimizers("shared"):
        optimizer.rows_on_device = 40
    trainer.logger.say = said.append  # type: ignore[method-assign]
    return trainer


def test_a_decision_is_carried_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trainer keeps moments of as many rows on the device as was decided, also after a refinement, and says so."""
    decision = Decision("moments", "Moments lie here and there.", {"shared": 40})
    monkeypatch.setattr(new_scenes, "decided", lambda *_, **__: decision)
    trainer = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture()))
    assert trainer.parts.scenes.notes == ("Moments lie here and there.",)
    while trainer.step < 5:
        trainer.train_step()
    assert len(trainer.state.gaussian_sets["shared"]) > 60
    optimizers = trainer.state.row_optimizers("shared")
    assert [len(optimizer.near) for optimizer in optimizers if optimizer.near is not None] == [40, 40]


def fail(trainer: Trainer, times: int, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """Let the next so many gradients end with an error when they are on the parameters."""
    gradients, left = trainer.device_step.gradients, [times]

    def failing(*args: Any, **kwargs: Any) -> Differentiated:
        done = gradients(*args, **kwargs)
        if left[0] > 0:
            left[0] -= 1
            raise error
        return done

    monkeypatch.setattr(trainer.device_step, "gradients", failing)


def test_a_step_makes_room_and_begins_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After two failures a quarter of the moments stays; what is trained is what would have been trained."""
    said: list[str] = []
    trainer, other = (trainer_of(tmp_path / name, said) for name in ("one", "other"))
    for one in (trainer, other):
        one.train_step()
        one.train_step()
    fail(trainer, 2, monkeypatch, torch.OutOfMemoryError("CUDA out of memory."))
    for one in (trainer, other):
        one.train_step()
    assert [line.split(" stay on it for ")[1].split(" from")[0] for line in said] == ["20 Gaussians", "10 Gaussians"]
    assert {optimizer.rows_on_device for optimizer in trainer.state.row_optimizers("shared")} == {10}
    found, expected = state_tensors(trainer), state_tensors(other)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value), name


def test_without_moments_to_move_it_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What needs more room than there is ends as before, with no step done."""
    said: list[str] = []
    trainer = trainer_of(tmp_path, said)
    trainer.train_step()
    fail(trainer, 100, monkeypatch, torch.OutOfMemoryError("CUDA out of memory."))
    with pytest.raises(torch.OutOfMemoryError):
        trainer.train_step()
    assert "for no Gaussian from now on" in said[-1]
    assert trainer.step == 1


def test_other_errors_move_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of another kind is raised as it is."""
    said: list[str] = []
    trainer = trainer_of(tmp_path, said)
    fail(trainer, 1, monkeypatch, RuntimeError("something else"))
    with pytest.raises(RuntimeError, match="something else"):
        trainer.train_step()
    assert not said
    assert {optimizer.rows_on_device for optimizer in trainer.state.row_optimizers("shared")} == {40}
