"""A training that is watched learns the same, obeys, and goes on when nobody watches any more."""

import threading
from pathlib import Path

import pytest

from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.viewer.training_watch import TrainingWatch
from thermosplat.viewer.turns import ViewingEnded
from thermosplat.viewer.viewed_scene import ViewedScene
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture
from viewed_toy import toy_session


def watched(tmp_path: Path, name: str, watch_it: bool):  # type: ignore[no-untyped-def]
    """A trainer of twelve steps, and what watches it."""
    capture = many_frames(toy_capture())
    trainer = toy_trainer(tmp_path / name, toy_run_config(), capture)
    if not watch_it:
        return trainer, None, None
    scene = ViewedScene("toy", trainer.model, trainer.sh_degree, dict(capture.scales), trainer.device, capture)
    watch = TrainingWatch(scene, 12, trainer.run.metrics_jsonl)
    watch.turns.share = 1.0
    watch.has_viewers = lambda: True
    trainer.between_steps = watch.between_steps
    session = toy_session(scene)
    session.turns = watch.turns
    return trainer, watch, session


def test_renders_between_steps_change_no_digit(tmp_path: Path) -> None:
    """Losses, Gaussians and decoders after twelve watched steps, with refinements, are those of unwatched ones."""
    plain, _, _ = watched(tmp_path, "plain", False)
    plain.train()
    trainer, watch, session = watched(tmp_path, "watched", True)
    pictures = []

    def look() -> None:
        start = session.renderer.scene.start()
        while True:
            try:
                session.forget_picture()
                pictures.append(session.render(start, 24, 18).picture)
            except ViewingEnded:
                return

    thread = threading.Thread(target=look)
    thread.start()
    trainer.train()
    watch.turns.end()
    thread.join(20)
    assert not thread.is_alive()
    assert len(pictures) >= 3
    assert (pictures[0] != pictures[-1]).any()
    assert_same_state(state_tensors(plain), state_tensors(trainer))
    assert watch.curves.read()


def test_stop_saves_and_ends_as_ctrl_c_does(tmp_path: Path) -> None:
    """The exit code of an interrupt, and a checkpoint of the whole step."""
    trainer, watch, _ = watched(tmp_path, "stopped", True)
    watch.stop()
    with pytest.raises(TrainingInterrupted) as stopped:
        trainer.train()
    assert stopped.value.exit_code == 130
    assert stopped.value.checkpoint.name == "step_000001.pt"
    assert stopped.value.checkpoint.is_file()


def test_save_writes_a_checkpoint_and_goes_on(tmp_path: Path) -> None:
    """Between two steps; the training ends as it would have."""
    trainer, watch, _ = watched(tmp_path, "saved", True)
    watch.save()
    trainer.train()
    assert trainer.step == 12
    assert (tmp_path / "saved" / "ckpts" / "step_000001.pt").is_file()
    assert "step_000001.pt" in watch.message
