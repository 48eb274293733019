"""A run goes on only with the model it was trained with."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from thermosplat.config import DecoderConfig, ModelConfig, OptimizerConfig, TrainConfig
from thermosplat.config.files import to_dict
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import other_frames
from thermosplat.runs.checkpoint_file import save_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.spectra import ColorSpace
from thermosplat.thermal.radiometry import PixelScale
from thermosplat.training.session.resuming import check_resumable, check_steps_left, newest_checkpoint
from toy_scene import with_spectra

CONFIG = TrainConfig(sh_degree=2)
THREE = with_spectra(CONFIG, nir={"opacity": "offset"})


def _scales(**kinds: ColorSpace) -> dict[str, PixelScale]:
    """Scales of RGB, pseudo-coloured thermal images, and of what else is named."""
    return {name: PixelScale(kind) for name, kind in ({"rgb": "photograph", "thermal": "color"} | kinds).items()}


def _run(path: Path, step: int = 100, config: TrainConfig = CONFIG, **kinds: ColorSpace) -> RunDirectory:
    run, scales = RunDirectory.create(path), _scales(**kinds)
    model = {
        "gaussian_sets": {"shared": {"means": torch.zeros(4, 3)}},
        "decoders": None,
        "color_spaces": {name: scale.kind for name, scale in scales.items()},
    }
    training = {"optimizers": None, "strategies": {}, "exposures": None, "seconds": {}}
    stored = {name: scale.state_dict() for name, scale in scales.items()}
    state = {"config": to_dict(config), "sh_degree": 0, "model": model, "scales": stored, "training": training}
    save_checkpoint(run.checkpoint(step), {"step": step, "train_frames": ["a", "b"], **state})
    return run


def _capture(*names: str, **kinds: ColorSpace) -> Capture:
    points = np.zeros((4, 3), np.float32)
    frames = tuple(Frame(name, {}) for name in names)
    colors = np.zeros((4, 3), np.uint8)
    return Capture("shed", Path("shed"), "colmap", frames, (), points, colors, _scales(**kinds))


CAPTURE = _capture("a", "b")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sh_degree": 3}, "was trained with sh_degree=2, the command asks for 3"),
        ({"model": ModelConfig(feature_dim=16)}, "model.feature_dim=8, the command asks for 16"),
        (
            {"spectra": with_spectra(CONFIG, thermal={"opacity": "shared"}).spectra},
            "spectra.thermal.opacity=offset, the command asks for shared",
        ),
        ({"decoder": DecoderConfig(hidden_dim=32)}, "decoder.hidden_dim=64, the command asks for 32"),
    ],
)
def test_other_models_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    """The first setting that differs is named with both values."""
    run = _run(tmp_path)
    with pytest.raises(UserError, match=message) as caught:
        check_resumable(newest_checkpoint(run), dataclasses.replace(CONFIG, **changes), run, CAPTURE)  # type: ignore[arg-type]
    assert caught.value.hint


def test_fewer_steps_than_done_are_refused(tmp_path: Path) -> None:
    """Both numbers are named; the step that is done is the least that can be asked for."""
    run = _run(tmp_path)
    checkpoint = newest_checkpoint(run)
    with pytest.raises(UserError, match="has done 100 steps, the command asks for 99 in all") as caught:
        check_steps_left(checkpoint, dataclasses.replace(CONFIG, max_steps=99), run)
    assert caught.value.hint
    check_steps_left(checkpoint, dataclasses.replace(CONFIG, max_steps=100), run)


@pytest.mark.parametrize(
    ("then", "now", "message"),
    [
        (THREE, CONFIG, "with spectra=rgb thermal nir, the command asks for rgb thermal"),
        (CONFIG, THREE, "with spectra=rgb thermal, the command asks for rgb thermal nir"),
        (
            THREE,
            dataclasses.replace(THREE, without=("nir",)),
            "with spectra=rgb thermal nir, the command asks for rgb thermal",
        ),
        (
            THREE,
            dataclasses.replace(THREE, spectra={name: THREE.spectra[name] for name in ("rgb", "nir", "thermal")}),
            "with spectra=rgb thermal nir, the command asks for rgb nir thermal",
        ),
        (THREE, with_spectra(THREE, nir={"opacity": "own"}), "with spectra.nir.opacity=offset, .* for own"),
        (
            THREE,
            with_spectra(THREE, nir={"modulated_by": "thermal"}),
            "with spectra.nir.modulated_by=None, .* for thermal",
        ),
        (THREE, with_spectra(THREE, nir={"start": "rgb"}), "with spectra.nir.start=points, .* for rgb"),
        (THREE, with_spectra(THREE, nir={"point_spread": 0.01}), "with spectra.nir.point_spread=0.0, .* for 0.01"),
        (THREE, with_spectra(THREE, nir={"features": None}), "with spectra.nir.features=a number, .* for null"),
    ],
)
def test_other_spectra_are_refused(tmp_path: Path, then: TrainConfig, now: TrainConfig, message: str) -> None:
    """The list of spectra, its order, and what of a spectrum decides which parameters there are."""
    run = _run(tmp_path, config=then, nir="scalar")
    with pytest.raises(UserError, match=message) as caught:
        check_resumable(newest_checkpoint(run), now, run, _capture("a", "b", nir="scalar"))
    assert caught.value.hint


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"features": 0.0, "loss": 2.0, "smoothness": 0.1},
        {"train_from": 0.5, "train_until": 0.9},
        {"palette": "iron", "range": (0.0, 2.0), "folders": ("near",)},
    ],
)
def test_what_may_change_of_a_spectrum(tmp_path: Path, settings: dict[str, object]) -> None:
    """Its weights, when it is trained and how it is read may; so may anything of one that is not modelled."""
    run = _run(tmp_path, config=THREE, nir="scalar")
    capture = _capture("a", "b", nir="scalar")
    check_resumable(newest_checkpoint(run), with_spectra(THREE, nir=settings), run, capture)
    left_out = with_spectra(CONFIG, nir=settings | {"opacity": "own"})
    left_out = dataclasses.replace(left_out, without=("nir",))
    run = _run(tmp_path / "two")
    check_resumable(newest_checkpoint(run), left_out, run, _capture("a", "b"))


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
    tmp_path: Path, then: ColorSpace, now: ColorSpace | None, message: str
) -> None:
    """Frames of the same names may still show something that the decoders were not made for; RGB alone may go on."""
    run = _run(tmp_path, thermal=then)
    checkpoint = newest_checkpoint(run)
    capture = _capture("a", "b")
    found = {"rgb": capture.scales["rgb"]} | ({} if now is None else {"thermal": PixelScale(now)})
    capture = dataclasses.replace(capture, scales=found)
    with pytest.raises(UserError, match=message):
        check_resumable(checkpoint, CONFIG, run, capture)
    check_resumable(checkpoint, CONFIG, run, _capture("a", "b", thermal=then))
    alone = dataclasses.replace(CONFIG, without=("thermal",))
    check_resumable(dataclasses.replace(checkpoint, config=alone), alone, run, capture)


def test_other_images_of_a_third_spectrum_are_refused(tmp_path: Path) -> None:
    """Each spectrum is held to what it was trained on, and called by its label."""
    run = _run(tmp_path, config=THREE, nir="scalar")
    captures: dict[str, Capture] = {
        "pseudo-coloured NIR images": _capture("a", "b", nir="color"),
        "photographs as NIR images": _capture("a", "b", nir="photograph"),
        "no NIR images": _capture("a", "b"),
    }
    for found, capture in captures.items():
        with pytest.raises(UserError, match=f"It was trained on NIR images of one channel, and shed has {found}."):
            check_resumable(newest_checkpoint(run), THREE, run, capture)


def test_checkpoints_without_frames_go_on(tmp_path: Path) -> None:
    """The first release did not store which frames it had trained on."""
    run = _run(tmp_path)
    checkpoint = newest_checkpoint(run)
    assert other_frames(checkpoint.train_frames, _capture("x"))
    check_resumable(dataclasses.replace(checkpoint, train_frames=None), CONFIG, run, _capture("x"))


def test_a_model_alone_cannot_be_trained_further(tmp_path: Path) -> None:
    """A checkpoint without the state of its training says so."""
    run = _run(tmp_path)
    save_checkpoint(run.checkpoint(200), {**newest_checkpoint(run).state(), "step": 200, "training": {"seconds": {}}})
    with pytest.raises(UserError, match=r"rendered but not trained further: .* optimizers, strategies, exposures are"):
        newest_checkpoint(run)


def test_newest_checkpoint_is_taken(tmp_path: Path) -> None:
    """Of several, the one with the most steps; without any, an error that says how to start again."""
    run = _run(tmp_path / "run")
    save_checkpoint(run.checkpoint(40), {**newest_checkpoint(run).state(), "step": 40})
    assert newest_checkpoint(run).step == 100
    empty = RunDirectory.create(tmp_path / "empty")
    with pytest.raises(UserError, match="no checkpoint to go on from"):
        newest_checkpoint(empty)
