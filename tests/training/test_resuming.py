"""A run goes on only with the model it was trained with."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from thermosplat.checkpoint import save_checkpoint
from thermosplat.config import DecoderConfig, ModelConfig, OptimizerConfig, TrainConfig
from thermosplat.config_files import to_dict
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError
from thermosplat.radiometry import ThermalScale
from thermosplat.run_directory import RunDirectory
from thermosplat.training.resuming import check_resumable, newest_checkpoint, other_frames

CONFIG = TrainConfig(sh_degree=2)


def _run(path: Path, step: int = 100) -> RunDirectory:
    run = RunDirectory.create(path)
    model = {"gaussian_sets": {}, "decoders": None, "thermal_channels": 3}
    training = {"optimizers": None, "strategies": {}, "exposures": None, "seconds": {}}
    state = {"config": to_dict(CONFIG), "sh_degree": 0, "model": model, "thermal_scale": None, "training": training}
    save_checkpoint(run.checkpoint(step), {"step": step, "train_frames": ["a", "b"], **state})
    return run


def _capture(*names: str) -> Capture:
    points = np.zeros((4, 3), np.float32)
    frames = tuple(Frame(name, None, None) for name in names)
    return Capture("shed", Path("shed"), "colmap", frames, (), points, np.zeros((4, 3), np.uint8), None)


CAPTURE = _capture("a", "b")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sh_degree": 3}, "was trained with sh_degree=2, the command asks for 3"),
        ({"model": ModelConfig(feature_dim=16)}, "model.feature_dim=8, the command asks for 16"),
        ({"model": ModelConfig(geometric_decoupling=False)}, "model.geometric_decoupling=True"),
        ({"decoder": DecoderConfig(hidden_dim=32)}, "decoder.hidden_dim=64, the command asks for 32"),
        ({"max_steps": 99}, "has done 100 steps, the command asks for 99 in all"),
    ],
)
def test_other_models_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    """The first setting that differs is named with both values."""
    run = _run(tmp_path)
    with pytest.raises(UserError, match=message) as caught:
        check_resumable(newest_checkpoint(run), dataclasses.replace(CONFIG, **changes), run, CAPTURE)  # type: ignore[arg-type]
    assert caught.value.hint


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"data_factor": 2, "max_steps": 60_000, "device": "cpu"},
        {"model": ModelConfig(init_opacity=0.5)},
        {"optimizer": OptimizerConfig(means_lr=1e-5)},
    ],
)
def test_what_may_change(tmp_path: Path, changes: dict[str, object]) -> None:
    """Rates, schedule, size of the images and device may; so may what only matters before the first step."""
    run = _run(tmp_path)
    check_resumable(newest_checkpoint(run), dataclasses.replace(CONFIG, **changes), run, CAPTURE)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("names", "first"), [(("a", "c"), "c"), (("a", "b", "d"), "d"), (("a",), "b"), (("b", "a"), "b")]
)
def test_another_capture_is_refused(tmp_path: Path, names: tuple[str, ...], first: str) -> None:
    """Frames that were exchanged, added, lost or reordered are told, by the first one that differs."""
    run = _run(tmp_path)
    with pytest.raises(
        UserError, match=rf"trained on 2 frames, and shed has {len(names)} .* \(first difference: {first}\)"
    ):
        check_resumable(newest_checkpoint(run), CONFIG, run, _capture(*names))


@pytest.mark.parametrize(
    ("then", "now", "message"),
    [
        ("color", "scalar", "on pseudo-coloured thermal images, and shed has thermal images of one channel"),
        ("scalar", "color", "on thermal images of one channel, and shed has pseudo-coloured thermal images"),
        ("color", None, "on pseudo-coloured thermal images, and shed has no thermal images"),
    ],
)
def test_other_thermal_images_are_refused(
    tmp_path: Path, then: Literal["color", "scalar"], now: Literal["color", "scalar"] | None, message: str
) -> None:
    """Frames of the same names may still show something that the decoders were not made for; RGB alone may go on."""
    run = _run(tmp_path)
    checkpoint = newest_checkpoint(run) | {"thermal_scale": ThermalScale(then).state_dict()}
    capture = dataclasses.replace(CAPTURE, thermal_scale=None if now is None else ThermalScale(now))
    with pytest.raises(UserError, match=message):
        check_resumable(checkpoint, CONFIG, run, capture)
    check_resumable(checkpoint, CONFIG, run, dataclasses.replace(capture, thermal_scale=ThermalScale(then)))
    alone = dataclasses.replace(CONFIG, model=ModelConfig(thermal=False))
    check_resumable(checkpoint | {"config": to_dict(alone)}, alone, run, capture)


def test_checkpoints_without_frames_go_on(tmp_path: Path) -> None:
    """The first release did not store which frames it had trained on."""
    run = _run(tmp_path)
    checkpoint = newest_checkpoint(run)
    assert other_frames(checkpoint.pop("train_frames"), _capture("x"))
    check_resumable(checkpoint, CONFIG, run, _capture("x"))


def test_a_model_alone_cannot_be_trained_further(tmp_path: Path) -> None:
    """A checkpoint without the state of its training says so."""
    run = _run(tmp_path)
    save_checkpoint(run.checkpoint(200), {**newest_checkpoint(run), "training": {"seconds": {}}})
    with pytest.raises(UserError, match=r"rendered but not trained further: .* optimizers, strategies, exposures are"):
        newest_checkpoint(run)


def test_newest_checkpoint_is_taken(tmp_path: Path) -> None:
    """Of several, the one with the most steps; without any, an error that says how to start again."""
    run = _run(tmp_path / "run")
    _save = newest_checkpoint(run)
    save_checkpoint(run.checkpoint(40), {**_save, "step": 40})
    assert newest_checkpoint(run)["step"] == 100
    empty = RunDirectory.create(tmp_path / "empty")
    with pytest.raises(UserError, match="no checkpoint to go on from"):
        newest_checkpoint(empty)
