"""A training that is stopped, by a signal, a full disk or memory, a lost folder or a bad loss, loses nothing."""

import contextlib
import errno
import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import NotWrittenError
from thermosplat.runs.checkpoint_file import load_checkpoint, save_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.model import SceneModel
from thermosplat.stop_signals import stopped_by_signals
from thermosplat.training import training_step
from thermosplat.training.session import checkpoint_writer, run_results
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.stages import density
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer
from toy_scene import toy_capture

pytestmark = pytest.mark.usefixtures("stoppable")


@pytest.fixture(scope="module")
def capture() -> Capture:
    """The toy capture with four training frames and one held out."""
    return many_frames(toy_capture())


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory, capture: Capture) -> dict[int, dict[str, torch.Tensor]]:
    """State after every step of an undisturbed run, by step."""
    trainer = toy_trainer(tmp_path_factory.mktemp("whole"), toy_run_config(), capture)
    states = {}
    while trainer.step < 12:
        trainer.train_step()
        states[trainer.step] = state_tensors(trainer)
    return states


@pytest.mark.parametrize("place", ["render", "compare_frame", "evaluate_refined"])
def test_interrupt_between_updates(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    """Ctrl-C while a step or an evaluation is being computed saves the last whole step, and nothing differs after."""
    config = toy_run_config(eval_steps=(4,))
    trainer = toy_trainer(tmp_path, config, capture)
    owner = {"render": trainer.model, "compare_frame": training_step, "evaluate_refined": run_results}[place]
    genuine: Callable[..., Any] = getattr(owner, place)

    def interrupted(*args: object, **kwargs: object) -> object:
        if trainer.step == 4:
            raise KeyboardInterrupt
        return genuine(*args, **kwargs)

    monkeypatch.setattr(owner, place, interrupted)
    with pytest.raises(TrainingInterrupted) as stop:
        trainer.train()
    monkeypatch.undo()
    assert stop.value.checkpoint == tmp_path / "ckpts" / "step_000004.pt"
    assert stop.value.resume_command == f"thermosplat-train --resume {tmp_path}"
    resumed = Trainer.resume(config, capture, RunDirectory.open(tmp_path))
    assert_same_state(state_tensors(resumed), whole_run[4])
    resumed.train()
    assert_same_state(state_tensors(resumed), whole_run[12])


@pytest.mark.parametrize(
    ("place", "number"),
    [("step_unless", signal.SIGINT), ("random_stream", signal.SIGINT), ("step_unless", signal.SIGTERM)],
)
def test_interrupt_during_an_update(
    tmp_path: Path,
    capture: Capture,
    whole_run: dict[int, Any],
    monkeypatch: pytest.MonkeyPatch,
    place: str,
    number: signal.Signals,
) -> None:
    """Ctrl-C or SIGTERM while optimizers or density control are at work lets them finish first."""
    trainer = toy_trainer(tmp_path, toy_run_config(), capture)
    owner = training_step if place == "step_unless" else density
    genuine: Callable[..., Any] = getattr(owner, place)
    done = []

    def interrupted(*args: Any, **kwargs: Any) -> object:
        if trainer.step >= (5 if place == "step_unless" else 6) and not done:
            os.kill(os.getpid(), number)
            done.append(1)
        return genuine(*args, **kwargs)

    monkeypatch.setattr(owner, place, interrupted)
    with pytest.raises(TrainingInterrupted) as stop, stopped_by_signals():
        trainer.train()
    assert stop.value.exit_code == 128 + number
    monkeypatch.undo()
    assert stop.value.checkpoint == tmp_path / "ckpts" / "step_000006.pt"
    resumed = Trainer.resume(toy_run_config(), capture, RunDirectory.open(tmp_path))
    assert_same_state(state_tensors(resumed), whole_run[6])


def test_a_signal_that_was_lost_is_heard(tmp_path: Path, capture: Capture) -> None:
    """C code may clear what a signal raised: the training stops before the next step all the same."""
    trainer = toy_trainer(tmp_path, toy_run_config(), capture)

    def lose(_: Trainer) -> None:
        if trainer.step == 4:
            with contextlib.suppress(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(1)

    trainer.between_steps = lose
    with pytest.raises(TrainingInterrupted) as stop, stopped_by_signals():
        trainer.train()
    assert stop.value.exit_code == 128 + signal.SIGTERM
    assert stop.value.checkpoint == tmp_path / "ckpts" / "step_000004.pt"


def write_when(monkeypatch: pytest.MonkeyPatch, ready: Callable[[Path], bool]) -> list[Path]:
    """Let every write of a checkpoint wait until it may begin; returns the files in the order they are done."""
    done: list[Path] = []

    def save(path: Path, state: dict[str, Any]) -> Path:
        for _ in range(1000):
            if ready(path):
                break
            time.sleep(0.01)
        done.append(save_checkpoint(path, state))
        return path

    monkeypatch.setattr(checkpoint_writer, "save_checkpoint", save)
    return done


def test_training_goes_on_while_a_checkpoint_is_written(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file holds the state of its own step, though it is written when the model has changed and grown."""
    config = toy_run_config(save_steps=(4,))
    trainer = toy_trainer(tmp_path, config, capture)
    done = write_when(monkeypatch, lambda path: trainer.step >= 8)
    trainer.train()
    monkeypatch.undo()
    assert [path.name for path in done] == ["step_000004.pt", "step_000012.pt"]
    done[1].unlink()
    resumed = Trainer.resume(config, capture, RunDirectory.open(tmp_path))
    assert_same_state(state_tensors(resumed), whole_run[4])
    resumed.train()
    assert_same_state(state_tensors(resumed), whole_run[12])


def test_interrupt_while_a_checkpoint_is_written(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C waits for the file that is being written, and for that of the step that was reached."""
    trainer = toy_trainer(tmp_path, toy_run_config(save_steps=(4,)), capture)
    interrupted = []
    genuine = trainer.model.render

    def render(*args: Any, **kwargs: Any) -> object:
        if trainer.step == 6 and not interrupted:
            interrupted.append(True)
            os.kill(os.getpid(), signal.SIGINT)
        return genuine(*args, **kwargs)

    monkeypatch.setattr(trainer.model, "render", render)
    done = write_when(monkeypatch, lambda path: bool(interrupted))
    with pytest.raises(TrainingInterrupted) as stop:
        trainer.train()
    assert [path.name for path in done] == ["step_000004.pt", "step_000006.pt"]
    assert stop.value.checkpoint == done[1]
    assert [load_checkpoint(path).step for path in done] == [4, 6]
    resumed = Trainer.resume(toy_run_config(), capture, RunDirectory.open(tmp_path))
    assert_same_state(state_tensors(resumed), whole_run[6])


def full_disk(monkeypatch: pytest.MonkeyPatch, is_full: Callable[[Path], bool]) -> None:
    """Let the writes of those checkpoints find a full disk."""

    def save(state: dict[str, Any], file: Any) -> None:
        if is_full(Path(file.name)):
            raise OSError(errno.ENOSPC, "No space left on device")
        genuine(state, file)

    genuine = torch.save
    monkeypatch.setattr(torch, "save", save)


def test_full_disk_beside_the_training_costs_a_file(
    tmp_path: Path,
    capture: Capture,
    whole_run: dict[int, Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """What cannot be saved on the way is said, training goes on, and the next checkpoint is tried."""
    trainer = toy_trainer(tmp_path, toy_run_config(save_steps=(4, 8), eval_steps=(5,)), capture)
    full_disk(monkeypatch, lambda path: "step_000004" in path.name)
    genuine = trainer.run.write_json

    def write_json(path: Path, value: dict[str, Any]) -> None:
        if path.name == "step_000005.json":
            raise NotWrittenError("Could not write step_000005.json: No space left on device.")
        genuine(path, value)

    monkeypatch.setattr(trainer.run, "write_json", write_json)
    trainer.train()
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("step_000004.pt: No space left on device. Training goes on") == 1
    assert said.count("step_000005.json: No space left on device. Training goes on") == 1
    assert sorted(path.name for path in (tmp_path / "ckpts").iterdir()) == ["step_000008.pt", "step_000012.pt"]
    assert_same_state(state_tensors(trainer), whole_run[12])


@pytest.mark.parametrize("stopped", [False, True])
def test_full_disk_at_the_end_names_what_there_is(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch, stopped: bool
) -> None:
    """At the last step, or at Ctrl-C, the message has the checkpoint that is saved and the command that goes on."""
    config = toy_run_config(save_steps=(4,))
    trainer = toy_trainer(tmp_path, config, capture)

    def render(*args: Any, **kwargs: Any) -> object:
        if stopped and trainer.step == 6:
            raise KeyboardInterrupt
        return SceneModel.render(trainer.model, *args, **kwargs)

    monkeypatch.setattr(trainer.model, "render", render)
    full_disk(monkeypatch, lambda path: "step_000004" not in path.name)
    last = 6 if stopped else 12
    with pytest.raises(UserError, match=rf"step_{last:06d}\.pt: No space left.* saved: .*step_000004\.pt") as caught:
        trainer.train()
    monkeypatch.undo()
    assert f"thermosplat-train --resume {tmp_path}" in caught.value.hint
    resumed = Trainer.resume(config, capture, RunDirectory.open(tmp_path))
    resumed.train()
    assert_same_state(state_tensors(resumed), whole_run[12])


def test_the_last_checkpoint_is_written_before_anything_else(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that pictures and PLY files would fill has room for it; what a killed run left lying goes, too."""
    trainer = toy_trainer(tmp_path, toy_run_config(save_steps=(4,)), capture)
    left = trainer.run.ckpts / ".step_000004.0123456789abcdef.tmp.pt"
    left.write_bytes(b"x")

    def evaluate(*args: Any, **kwargs: Any) -> None:
        assert trainer.run.checkpoint(12).is_file()
        assert not left.exists()
        assert not any(trainer.run.renders.iterdir())
        assert not any(trainer.run.ply.iterdir())
        raise NotWrittenError("Could not write renders/a.png: No space left on device.")

    monkeypatch.setattr(run_results, "evaluate_refined", evaluate)
    monkeypatch.setattr(trainer.results, "exporting", lambda: lambda: None)
    with pytest.raises(UserError, match=r"renders/a\.png: No space left.* saved: .*step_000012\.pt"):
        trainer.train()
    assert_same_state(state_tensors(Trainer.resume(toy_run_config(), capture, trainer.run)), whole_run[12])


def test_an_evaluation_that_a_kill_prevented_is_made_up_for(tmp_path: Path, capture: Capture) -> None:
    """The checkpoint of a step may be there before its evaluation: the resumed run begins with that."""
    config = toy_run_config(save_steps=(4,), eval_steps=(4,))
    toy_trainer(tmp_path, config, capture).train()
    numbers, lines = tmp_path / "stats" / "step_000004.json", tmp_path / "metrics.jsonl"
    before, evaluation = lines.read_text(), numbers.read_bytes()
    numbers.unlink()
    (tmp_path / "ckpts" / "step_000012.pt").unlink()
    Trainer.resume(config, capture, RunDirectory.open(tmp_path)).train()
    assert numbers.read_bytes() == evaluation
    after = lines.read_text()
    evaluated = [[json.loads(line) for line in text.splitlines() if "evaluation" in line] for text in (before, after)]
    assert evaluated[0] == evaluated[1]


@pytest.mark.rotating
@pytest.mark.parametrize("fate", ["renamed", "removed", "replaced"])
@pytest.mark.parametrize("when", [6, 12])
def test_a_result_folder_that_goes_away_ends_the_training_with_its_place(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch, fate: str, when: int
) -> None:
    """Nothing is lost: the checkpoint is where the folder is now, or anew where it was, and not in another's run."""
    folder = tmp_path / "run"
    trainer = toy_trainer(folder, toy_run_config(save_steps=(4,)), capture)
    genuine = trainer.logger.step

    def step(record: Any) -> None:
        genuine(record)
        if record.step == when:
            trainer.keeping.writer.wait()
            folder.rename(tmp_path / "gone")
            if fate != "renamed":
                shutil.rmtree(tmp_path / "gone")
            if fate == "replaced":
                folder.mkdir()
                (folder / "config.yaml").write_text("another's")

    monkeypatch.setattr(trainer.logger, "step", step)
    became = f"renamed to {tmp_path / 'gone'}" if fate == "renamed" else "removed"
    with pytest.raises(UserError, match=f"run was {became} during the training") as caught:
        trainer.train()
    now = tmp_path / {"renamed": "gone", "removed": "run", "replaced": "run_removed"}[fate]
    assert f"saved to {now / 'ckpts' / f'step_{when:06d}.pt'}" in caught.value.message
    assert caught.value.hint == f"Go on with: thermosplat-train --resume {now}"
    resumed = Trainer.resume(toy_run_config(), capture, RunDirectory.open(now))
    assert_same_state(state_tensors(resumed), whole_run[when])
    if fate == "replaced":
        assert [entry.name for entry in folder.iterdir()] == ["config.yaml"]
    assert not list(tmp_path.rglob("training.lock"))


@pytest.mark.parametrize("looks_every", [1, 3])
def test_nan_stops_with_the_last_good_state(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch, looks_every: int
) -> None:
    """A NaN loss names term, step and frame, and what is saved is the step before, also where nobody looked at once."""
    trainer = toy_trainer(tmp_path, toy_run_config(), capture)
    genuine = training_step.compare_frame

    def spoiled(*args: Any) -> Any:
        compared = genuine(*args)
        if trainer.step == 7:
            compared.losses["thermal_smoothness"] = compared.losses["thermal_smoothness"] * torch.nan
        return compared

    monkeypatch.setattr(training_step, "compare_frame", spoiled)
    monkeypatch.setattr(trainer, "looks_at_guard", lambda step: step % looks_every == 0)
    with pytest.raises(UserError, match=r"NaN or infinite at step 8 \(term: thermal_smoothness; frame: frame\d\)") as e:
        trainer.train()
    monkeypatch.undo()
    assert "step_000007.pt" in e.value.message
    assert [path.name for path in (tmp_path / "ckpts").iterdir()] == ["step_000007.pt"]
    resumed = Trainer.resume(toy_run_config(), capture, RunDirectory.open(tmp_path))
    assert_same_state(state_tensors(resumed), whole_run[7])


def test_guard_is_looked_at_where_a_bad_state_would_spread(tmp_path: Path, capture: Capture) -> None:
    """On a device that is not waited for at every step, refinements, resets, evaluations and files still wait."""
    config = toy_run_config(max_steps=40, eval_steps=(16,), save_steps=(17,))
    trainer = toy_trainer(tmp_path, config, capture)
    trainer.device = torch.device("cuda")  # nothing is computed here
    refined, reset, logged = {*range(4, 41, 3)}, {*range(6, 41, 5)}, {*range(5, 41, 5)}
    assert {step for step in range(1, 41) if trainer.looks_at_guard(step)} == refined | reset | logged | {16, 17, 40}


def test_out_of_memory_saves_and_tells(
    tmp_path: Path, capture: Capture, whole_run: dict[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory that runs out in the renderer costs the step it was needed for, no more."""
    trainer = toy_trainer(tmp_path, toy_run_config(), capture)
    genuine = trainer.model.render

    def exhausted(*args: Any, **kwargs: Any) -> object:
        if trainer.step == 5:
            raise RuntimeError("Failed to allocate 8589934592 bytes on device 'cuda:0'")
        return genuine(*args, **kwargs)

    monkeypatch.setattr(trainer.model, "render", exhausted)
    with pytest.raises(UserError, match=r"Out of memory at step 6 with \d+ Gaussians at 24x18\. Checkpoint saved") as e:
        trainer.train()
    monkeypatch.undo()
    assert f"thermosplat-train --resume {tmp_path}" in e.value.hint
    resumed = Trainer.resume(toy_run_config(), capture, RunDirectory.open(tmp_path))
    assert_same_state(state_tensors(resumed), whole_run[5])


def test_other_errors_are_not_hidden(tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A defect of the program comes through as it is, and leaves no checkpoint that looks like progress."""
    trainer = toy_trainer(tmp_path, toy_run_config(), capture)

    def broken(*args: object, **kwargs: object) -> object:
        raise RuntimeError("shapes do not fit")

    monkeypatch.setattr(trainer.model, "render", broken)
    with pytest.raises(RuntimeError, match="shapes do not fit"):
        trainer.train()
    assert list((tmp_path / "ckpts").glob("*")) == []
