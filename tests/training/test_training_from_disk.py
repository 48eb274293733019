"""A training whose images stay on the disk is the same training, and goes on when an image was lost."""

import dataclasses
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from capture_folders import HEIGHT, WIDTH, write_image, write_rgbt_scenes
from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.datasets import load_capture
from thermosplat.datasets.capture import Capture
from thermosplat.datasets.frame_tensors import packed_memory
from thermosplat.datasets.kept_images import keep_images
from thermosplat.errors import UserError
from thermosplat.runs.atomic_writes import NotWrittenError
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.session.interruption import TrainingInterrupted
from thermosplat.training.sharing.same_capture import capture_digests
from thermosplat.training.trainer import Trainer
from toy_run import assert_same_state, state_tensors, toy_run_config, toy_trainer

pytestmark = pytest.mark.usefixtures("stoppable")

LITTLE = 0.000_15
"""GB that a few frames of 24 fit into."""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Of 24 frames, three of them held out."""
    return write_rgbt_scenes(tmp_path / "capture", 24, folders=False)


def on_disk(root: Path) -> Capture:
    capture = load_capture(root, image_memory=LITTLE)
    assert capture.on_disk is not None
    return capture


BUDGET = AutoBudgetConfig(prune_at=(0.5,), validate_every=2)
NOISY = {"thermal": {"by_noise": True}}


@pytest.mark.rotating
@pytest.mark.parametrize(
    "config",
    [
        toy_run_config(8, eval_steps=(4,), spectra=NOISY),
        toy_run_config(8, budget="auto", auto_budget=BUDGET),
        toy_run_config(6, refine=("poses", "rig"), refine_from=1, refine_every=1, refine_first=3),
        toy_run_config(4, batch_size=3),
        toy_run_config(6, data_factor=1, eval_steps=(4,)),
    ],
    ids=["plain", "budget", "refined", "batches", "masked"],
)
def test_the_same_digits(
    tmp_path: Path,
    root: Path,
    config: TrainConfig,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    """The same frames at the same steps, the same measurements between them, the same evaluations."""
    if "masked" in request.node.name:
        _write_masks(root)
    monkeypatch.setattr("thermosplat.evaluation.held_out_poses.STEPS", 3)
    held = toy_trainer(tmp_path / "held", config, load_capture(root))
    read = toy_trainer(tmp_path / "read", config, on_disk(root))
    expected, found = held.train(), read.train()
    assert_same_state(state_tensors(held), state_tensors(read))
    for name in ("rgb", "thermal"):
        assert found[name] == expected[name]
    assert not (tmp_path / "read" / "pixels").exists()


def _write_masks(root: Path) -> None:
    """Of every image, half of it; of odd frames the other half."""
    for number in range(24):
        for folder in ("rgb", "thermal"):
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[:, :16] *= number % 2
            mask[:, 16:] *= 1 - number % 2
            write_image(root / "masks" / folder / f"{number:04d}.png", mask)


def test_an_image_that_vanishes(tmp_path: Path, root: Path) -> None:
    """The message names it and the checkpoint; with the image back the training goes on as if nothing had been."""
    config = toy_run_config(8)
    whole = toy_trainer(tmp_path / "whole", config, load_capture(root))
    whole.train()
    trainer = toy_trainer(tmp_path / "run", config, on_disk(root))
    lost = trainer.schedule.frame(6).views["thermal"].path
    lost.rename(tmp_path / "lost.png")
    with pytest.raises(UserError) as caught:
        trainer.train()
    saved = RunDirectory(tmp_path / "run").latest_checkpoint()
    assert caught.value.message == f"Cannot read {lost}: No such file or directory. Checkpoint saved to {saved}."
    assert caught.value.hint == f"Restore it. Then go on with: {trainer.run.resume_command()}"
    assert saved == trainer.run.checkpoint(6)
    assert list((tmp_path / "run" / "pixels").iterdir())
    (tmp_path / "lost.png").rename(lost)
    again = Trainer.resume(config, on_disk(root), RunDirectory(tmp_path / "run"))
    again.train()
    assert_same_state(state_tensors(whole), state_tensors(again))
    assert not (tmp_path / "run" / "pixels").exists()


def test_what_was_kept_serves_a_resumed_run(tmp_path: Path, root: Path) -> None:
    """Of the frames that were seen nothing is read again; --overwrite deletes it."""
    config = dataclasses.replace(toy_run_config(21), save_steps=(20,))
    trainer = toy_trainer(tmp_path / "run", config, on_disk(root))

    def stop(trainer: Trainer) -> None:
        if trainer.step == 20:
            raise KeyboardInterrupt

    trainer.between_steps = stop
    with pytest.raises(Exception, match="Interrupted"):
        trainer.train()
    kept = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "run" / "pixels").iterdir()}
    assert len(kept) >= 20 * 3
    again = Trainer.resume(config, on_disk(root), RunDirectory(tmp_path / "run"))
    seen: dict[str, int] = {}

    def look(_: Trainer) -> None:
        seen.update({file.name: file.stat().st_mtime_ns for file in (tmp_path / "run" / "pixels").iterdir()})

    again.between_steps = look
    keep_images(again.capture, again.run.path)
    look(again)
    assert kept.items() <= seen.items()
    RunDirectory.create(tmp_path / "run", overwrite=True)
    assert not (tmp_path / "run" / "pixels").exists()


def interrupted_at(trainer: Trainer, step: int) -> None:
    """Train, and press Ctrl-C after a step."""

    def stop(trainer: Trainer) -> None:
        if trainer.step == step:
            raise KeyboardInterrupt

    trainer.between_steps = stop
    with pytest.raises(TrainingInterrupted):
        trainer.train()


def test_kept_images_that_are_damaged(tmp_path: Path, root: Path) -> None:
    """By a power cut: they are made again, and the resumed training is the same."""
    config = toy_run_config(25)
    whole = toy_trainer(tmp_path / "whole", config, load_capture(root))
    whole.train()
    interrupted_at(toy_trainer(tmp_path / "run", config, on_disk(root)), 20)
    files = sorted((tmp_path / "run" / "pixels").iterdir())
    for number, file in enumerate(files):
        content = file.read_bytes()
        file.write_bytes(
            (b"", bytes(len(content)), content[:-9], content[:150] + bytes(len(content) - 150))[number % 4]
        )
    again = Trainer.resume(config, on_disk(root), RunDirectory(tmp_path / "run"))
    again.train()
    assert_same_state(state_tensors(whole), state_tensors(again))
    assert not (tmp_path / "run" / "pixels").exists()


def test_nothing_can_be_kept(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk becomes full: images are decoded each time, and the training is the same."""

    def full(path: Path, *_: object, **__: object) -> None:
        raise NotWrittenError(f"Could not write {path}: No space left on device.")

    config = toy_run_config(25)
    whole = toy_trainer(tmp_path / "whole", config, load_capture(root))
    whole.train()
    monkeypatch.setattr("thermosplat.datasets.pixel_cache.write_atomically", full)
    trainer = toy_trainer(tmp_path / "run", config, on_disk(root))
    kept: list[Path] = []
    trainer.between_steps = lambda trainer: kept.extend((tmp_path / "run" / "pixels").iterdir())
    trainer.train()
    assert kept == []
    assert_same_state(state_tensors(whole), state_tensors(trainer))


def test_a_reader_that_is_killed(tmp_path: Path, root: Path) -> None:
    """As where memory is short: the state is saved, and the command in the message goes on to the same numbers."""
    config = toy_run_config(25)
    whole = toy_trainer(tmp_path / "whole", config, load_capture(root))
    whole.train()
    trainer = toy_trainer(tmp_path / "run", config, on_disk(root))

    def kill(trainer: Trainer) -> None:
        if trainer.step == 5:
            assert trainer.frames.from_disk is not None
            for process in trainer.frames.from_disk.loader.reading.processes:
                process.kill()

    trainer.between_steps = kill
    with pytest.raises(UserError, match="was ended by the system, as it does where memory is short") as caught:
        trainer.train()
    assert f"Checkpoint saved to {tmp_path / 'run' / 'ckpts'}" in caught.value.message
    assert trainer.run.resume_command() in caught.value.hint
    assert trainer.frames.from_disk.loader.reading is None
    again = Trainer.resume(config, on_disk(root), RunDirectory(tmp_path / "run"))
    assert 5 <= again.step < 25
    again.train()
    assert_same_state(state_tensors(whole), state_tensors(again))


def test_no_process_is_left(tmp_path: Path, root: Path) -> None:
    """After Ctrl-C, and after the last step."""
    before = set(active_children())
    trainer = toy_trainer(tmp_path / "run", toy_run_config(25), on_disk(root))
    interrupted_at(trainer, 3)
    assert set(active_children()) == before
    Trainer.resume(toy_run_config(25), on_disk(root), RunDirectory(tmp_path / "run")).train()
    assert set(active_children()) == before


def test_too_little_memory_for_a_frame(tmp_path: Path, root: Path) -> None:
    """It is refused before anything is written."""
    capture = load_capture(root, image_memory=1e-6)
    with pytest.raises(UserError, match="--image-memory 1e-06 is too little"):
        Trainer(toy_run_config(4), capture, RunDirectory(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_ranks_compare_what_they_have_not_read(root: Path) -> None:
    """By the files' sizes; a capture in memory is told from one on the disk."""
    digests = capture_digests(on_disk(root))
    assert digests == capture_digests(on_disk(root))
    held = capture_digests(load_capture(root))
    different = [name for name in digests if digests[name] != held[name]]
    assert different[0] == "the place of the images, in memory or (beyond --image-memory) on the disk,"
    path = root / "rgb" / "0001.png"
    path.write_bytes(path.read_bytes() + b"more")
    other = capture_digests(on_disk(root))
    (name,) = (name for name in digests if digests[name] != other[name])
    assert name == "the rgb view of the training frame 0001, 0001.png,"


@pytest.mark.cuda
@pytest.mark.parametrize("changes", [{}, {"graph": False}, {"batch_size": 3}], ids=["captured", "plain", "batches"])
def test_frames_on_a_gpu(tmp_path: Path, root: Path, changes: dict[str, Any]) -> None:
    """Copied while another step runs, they are those in memory; a training goes through all of them in its order."""
    config = dataclasses.replace(toy_run_config(30), device="cuda", **changes)
    held = toy_trainer(tmp_path / "held", config, load_capture(root))
    read = toy_trainer(tmp_path / "read", config, on_disk(root))
    steps = held.config.max_steps  # 30, or a third where a step has three frames
    for step in range(steps):
        expected, found = held.schedule.tensors(step), read.schedule.tensors(step)
        assert found.name == expected.name
        for name, view in found.views.items():
            assert torch.equal(view.image, expected.views[name].image)
            assert torch.equal(view.viewmat, expected.views[name].viewmat)
        assert packed_memory(found).shape == packed_memory(expected).shape
        # on the GPU the inverse of a palette is rounded otherwise than here
        torch.testing.assert_close(found.packable(), expected.packable(), rtol=0, atol=1e-5)
    read.frames.close()
    read.train()
    assert read.step == steps
    assert not (tmp_path / "read" / "pixels").exists()
