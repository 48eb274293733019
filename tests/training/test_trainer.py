"""The loop trains, stops at any moment without loss, and goes on exactly where it stopped."""

import contextlib
import csv
import dataclasses
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

from thermosplat.config import DensificationConfig, LossConfig, OptimizerConfig, TrainConfig
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import NotWrittenError
from thermosplat.runs.checkpoint_file import load_checkpoint, save_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.model import SceneModel
from thermosplat.stop_signals import stopped_by_signals
from thermosplat.training import trainer as trainer_module
from thermosplat.training import training_step
from thermosplat.training.session import checkpoint_writer, run_results
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, many_frames, state_tensors, toy_run_config, toy_trainer, without
from toy_scene import toy_capture

pytestmark = pytest.mark.usefixtures("stoppable")

SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0}
NIR = {"others": ("nir",)}
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "shared": ({}, {}),
    "shared, two cameras": ({}, {"aligned": False}),
    "separate, scalar thermal": ({"model": SEPARATE}, {"thermal_kind": "scalar"}),
    "three spectra, two opacities": ({"spectra": {"nir": {}}}, NIR),
    "three spectra, three opacities, two cameras": (
        {"spectra": {"nir": {"opacity": "own", "modulated_by": "thermal", "train_from": 0.3}}},
        {"aligned": False} | NIR,
    ),
    "three spectra, spherical harmonics": (
        {"model": {"feature_dim": 0}, "spectra": {"nir": {"opacity": "offset"}}},
        NIR,
    ),
    "three spectra, separate": ({"model": SEPARATE, "spectra": {"nir": {"train_until": 0.7}}}, NIR),
}


@pytest.fixture(params=KINDS)
def task(request: pytest.FixtureRequest) -> tuple[TrainConfig, Capture]:
    """Every kind of model and capture that trains differently."""
    config, capture = KINDS[request.param]
    return toy_run_config(**config), many_frames(toy_capture(**capture))


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
        trainer._train_step()
        states[trainer.step] = state_tensors(trainer)
    return states


def test_resumed_run_is_the_same_to_the_bit(tmp_path: Path, task: tuple[TrainConfig, Capture]) -> None:
    """Twelve steps equal six, a checkpoint, and six more, with Gaussians added, removed and reset in both halves."""
    config, capture = task
    whole = toy_trainer(tmp_path / "whole", config, capture)
    counts = [whole.model.num_gaussians]
    while whole.step < 12:
        whole._train_step()
        counts.append(whole.model.num_gaussians)
    assert len(set(counts[:7])) > 1
    assert len(set(counts[6:])) > 1

    first = toy_trainer(tmp_path / "halves", config, capture)
    while first.step < 6:
        first._train_step()
    first._save()
    second = Trainer.resume(config, capture, RunDirectory.open(tmp_path / "halves"))
    assert second.step == 6
    assert_same_state(state_tensors(second), state_tensors(first))
    second.train()
    assert_same_state(state_tensors(second), state_tensors(whole))


def test_results_of_a_run(tmp_path: Path, capture: Capture) -> None:
    """A run leaves the numbers, pictures, files and checkpoints that the README promises."""
    config = toy_run_config(max_steps=7, save_steps=(3, 7), eval_steps=(4, 7))
    metrics = toy_trainer(tmp_path, config, capture).train()
    run = RunDirectory.open(tmp_path)
    written = json.loads(run.metrics_json.read_text())
    assert written == metrics
    assert list(written)[:7] == ["rgb", "thermal", "spectra", "num_gaussians", "steps", "train_seconds", "device"]
    assert written["spectra"] == ["rgb", "thermal"]
    assert list(written["rgb"]) == ["psnr", "ssim", "lpips"]
    assert list(written["thermal"]) == ["psnr", "ssim", "lpips", "mae_celsius"]
    assert written["thermal"]["mae_celsius"] > 0
    assert written["steps"] == 7
    assert 0 < written["train_seconds"] < written["wall_seconds"]
    assert sum(written["gaussians"].values()) == written["num_gaussians"]
    assert sorted(path.name for path in run.ckpts.iterdir()) == ["step_000003.pt", "step_000007.pt"]
    assert sorted(path.name for path in run.ply.iterdir()) == ["splat_rgb.ply", "splat_thermal.ply"]
    assert [path.name for path in run.renders.iterdir()] == ["frame0.png"]
    with (run.stats / "per_view.csv").open() as file:
        assert [(row["frame"], row["spectrum"]) for row in csv.DictReader(file)] == [
            ("frame0", "rgb"),
            ("frame0", "thermal"),
        ]
    lines = [json.loads(line) for line in run.metrics_jsonl.read_text().splitlines()]
    assert [line["step"] for line in lines if "evaluation" in line] == [4, 7]
    assert [line["step"] for line in lines if "loss" in line] == [5, 7]
    assert json.loads((run.stats / "step_000007.json").read_text())["rgb"] == written["rgb"]
    assert run.config_yaml.is_file()
    assert run.environment_json.is_file()


def test_training_learns(tmp_path: Path, capture: Capture) -> None:
    """Both spectra of the frames trained on get closer to their images."""
    config = toy_run_config(
        max_steps=60,
        densification=DensificationConfig(enabled=False),
        optimizer=OptimizerConfig(decoders_lr=1e-2, decoders_lr_final=1e-2),
    )
    capture = dataclasses.replace(capture, train=capture.train[:1], test=capture.train[:1])
    trainer = toy_trainer(tmp_path, config, capture)
    before = trainer.results.evaluate().metrics
    after = trainer.train()
    assert after["rgb"]["psnr"] > before["rgb"]["psnr"] + 1.0
    assert after["thermal"]["psnr"] > before["thermal"]["psnr"] + 0.5


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
    owner = training_step if place == "step_unless" else trainer_module
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
            trainer.checkpoints.wait()
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
    monkeypatch.setattr(trainer, "_looks_at_guard", lambda step: step % looks_every == 0)
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
    assert {step for step in range(1, 41) if trainer._looks_at_guard(step)} == refined | reset | logged | {16, 17, 40}


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


def test_finished_run_can_be_judged_again(tmp_path: Path, capture: Capture) -> None:
    """Resuming a run that has done its steps evaluates it again and changes nothing."""
    config = toy_run_config(max_steps=4)
    first = toy_trainer(tmp_path, config, capture).train()
    again = Trainer.resume(config, capture, RunDirectory.open(tmp_path)).train()
    for key in ("rgb", "thermal", "num_gaussians", "steps", "train_seconds", "device"):
        assert again[key] == first[key]


def test_no_loss_is_an_error(tmp_path: Path, capture: Capture) -> None:
    """With all weights at zero there is nothing to learn, and the message says so."""
    weightless = {"rgb": {"loss": 0.0}, "thermal": {"loss": 0.0, "smoothness": 0.0}}
    config = toy_run_config(spectra=weightless, loss=LossConfig(features=0.0))
    with pytest.raises(UserError, match="All loss weights are 0") as caught:
        toy_trainer(tmp_path, config, capture).train()
    assert caught.value.hint == "Set the loss of a spectrum, such as --rgb.loss 1."


def test_frames_of_one_spectrum_train_what_they_show(tmp_path: Path, capture: Capture) -> None:
    """A frame without a thermal image trains the rest; both kinds of frames in one run."""
    frames = tuple(without(frame, "thermal") if index % 2 else frame for index, frame in enumerate(capture.train))
    metrics = toy_trainer(tmp_path, toy_run_config(), dataclasses.replace(capture, train=frames)).train()
    assert metrics["steps"] == 12
    assert metrics["thermal"]["psnr"] > 0


@pytest.mark.cuda
def test_cuda_run_goes_on_on_the_cpu(tmp_path: Path, capture: Capture) -> None:
    """A checkpoint of a GPU is read on a machine without one, and training goes on from it."""
    first = toy_trainer(tmp_path, toy_run_config(max_steps=7, device="cuda"), capture)
    assert first.train()["device"] == torch.cuda.get_device_name()
    resumed = Trainer.resume(toy_run_config(device="cpu"), capture, RunDirectory.open(tmp_path))
    on_gpu = {name: tensor.cpu() for name, tensor in state_tensors(first).items()}
    assert_same_state(state_tensors(resumed), on_gpu)
    assert resumed.train()["steps"] == 12


@pytest.mark.parametrize(("config", "recommended"), [("thermosplat", True), ("demo", False)])
def test_the_demo_is_not_recommended_to_itself(
    tmp_path: Path, capture: Capture, monkeypatch: pytest.MonkeyPatch, config: str, recommended: bool
) -> None:
    """On the CPU a run hears of the demo preset, unless it is one."""
    trainer = toy_trainer(tmp_path, toy_run_config(1, config=config), capture)
    said: list[str] = []
    monkeypatch.setattr(trainer.logger, "say", said.append)
    trainer.train()
    assert any("training on the CPU" in line or "Training on the CPU" in line for line in said)
    assert any("--config demo" in line for line in said) is recommended


def test_decoder_precision_reaches_the_step(tmp_path: Path, capture: Capture) -> None:
    """bfloat16 decoders change what a step does, a little; tf32 on the CPU is float32."""
    states = {}
    for precision in ("float32", "tf32", "bfloat16"):
        config = dataclasses.replace(toy_run_config(), decoder_precision=precision)
        trainer = toy_trainer(tmp_path / precision, config, capture)
        trainer._train_step()
        states[precision] = trainer.model.gaussians("shared").features.detach().clone()
    assert torch.equal(states["float32"], states["tf32"])
    assert not torch.equal(states["float32"], states["bfloat16"])
    assert (states["float32"] - states["bfloat16"]).abs().max() < 0.02


def test_degree_4_trains_and_is_saved(tmp_path: Path) -> None:
    """Its coefficients exist from the start, move once the degree is in use, and are in the checkpoint."""
    config = toy_run_config(6, sh_degree=4, sh_degree_interval=1)
    trainer = toy_trainer(tmp_path / "run", config, many_frames(toy_capture()))
    trainer.train()
    (higher,) = [value for name, value in trainer.model.named_parameters() if name.endswith("shN")]
    assert higher.shape[1:] == (24, 3)
    assert higher[:, 15:].abs().sum() > 0
    saved = load_checkpoint(trainer.run.latest_checkpoint())
    assert saved.sh_degree == 4
