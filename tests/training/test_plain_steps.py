"""Steps line by line are done as a whole or not at all."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.training.step_kind import StepKind
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture

pytestmark = pytest.mark.usefixtures("stoppable")
KIND = StepKind(0, densifying=False)


def test_interrupt_waits_for_the_block(tmp_path: Path) -> None:
    """The block is what goes with the step: Ctrl-C in it is heard when it has ended."""
    trainer = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture()))
    done = []
    trainer.state.begin_step(1, trainer.config.optimizer)
    with pytest.raises(KeyboardInterrupt), trainer.steps.run(KIND) as values:  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        done.append(trainer.step)
    assert done == [1]
    assert {"rgb", "thermal"} <= values.losses.keys()
    assert values.squared_errors.keys() == {"rgb", "thermal"}


def test_interrupt_before_the_gradients_undoes_the_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while a frame is rendered: parameters and number of steps are as before."""
    trainer = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture()))
    before = state_tensors(trainer)

    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(trainer.model, "render", interrupted)
    with pytest.raises(KeyboardInterrupt), trainer.steps.run(KIND):
        pass
    assert trainer.step == 0
    assert_same_state(state_tensors(trainer), before)


def test_nothing_recorded_is_forgotten(tmp_path: Path) -> None:
    """A step after ``forget`` and ``check_overflow`` does what one without them does."""
    states = []
    for name, called in (("with", True), ("without", False)):
        trainer = toy_trainer(tmp_path / name, toy_run_config(), many_frames(toy_capture()))
        trainer.train_step()
        if called:
            trainer.steps.forget(kernels=True)
            trainer.steps.check_overflow()
        trainer.train_step()
        states.append(state_tensors(trainer))
    assert_same_state(*states)
    assert all(torch.isfinite(value).all() for value in states[0].values())
