"""More spectra than two train, are judged and exported; what one of them lacks costs the others nothing."""

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.config import DensificationConfig, OptimizerConfig
from thermosplat.datasets.capture import Capture
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.model import SceneModel
from thermosplat.training.trainer import Trainer
from toy_run import (
    assert_same_state,
    many_frames,
    state_tensors,
    stopped_and_resumed,
    toy_run_config,
    toy_trainer,
    without,
)
from toy_scene import toy_capture

SEPARATE = {"gaussian_sets": "separate", "feature_dim": 0}
BANDS = tuple(f"band_{number}" for number in range(1, 9))
TEN = ("rgb", "thermal", *BANDS)
THREE = ("rgb", "thermal", "nir")


def ten_spectra() -> dict[str, dict[str, Any]]:
    """Eight bands of which some share α, some move with it, some have their own, and two have no latent channel."""
    opacities = ("shared", "offset", "own", "shared")
    bands = {name: {"opacity": opacities[number % 4]} for number, name in enumerate(BANDS)}
    return bands | {name: bands[name] | {"features": None} for name in BANDS[-2:]}


def smooth(capture: Capture) -> Capture:
    """The capture with images, and values, that are easy to learn, of every spectrum; its frame is held out as well."""
    (frame,) = capture.train
    views = {}
    for number, (name, view) in enumerate(frame.views.items()):
        height, width, channels = view.image.shape
        x = np.linspace(0.1, 0.9, width)[None, :, None] * np.ones((height, 1, channels))
        image = x if number % 2 else 1.0 - x
        image = np.rint(255 * image).astype(np.uint8) if view.image.dtype == np.uint8 else image.astype(np.float32)
        scale = capture.scales[name]
        low, high = scale.range or (0.0, 1.0)
        values = None if view.values is None else (low + (high - low) * x[..., 0]).astype(np.float32)
        values = values if number % 2 or values is None else low + high - values
        views[name] = dataclasses.replace(view, image=image, values=values)
    frames = (dataclasses.replace(frame, views=views),)
    return dataclasses.replace(capture, train=frames, test=frames)


@pytest.mark.rotating
@pytest.mark.parametrize(
    ("model", "nir"),
    [
        ({}, {}),
        ({}, {"opacity": "offset", "modulated_by": "thermal"}),
        ({}, {"opacity": "own", "features": None}),
        ({"feature_dim": 0}, {"opacity": "own"}),
        (SEPARATE, {}),
    ],
)
@pytest.mark.parametrize("aligned", [True, False])
def test_three_spectra_learn(tmp_path: Path, model: dict[str, Any], nir: dict[str, Any], aligned: bool) -> None:
    """Each gets closer to its images, however its opacity is stored and wherever its camera is."""
    config = toy_run_config(
        60,
        model=model,
        spectra={"nir": nir},
        densification=DensificationConfig(stop_step=0),
        optimizer=OptimizerConfig(decoders_lr=1e-2, decoders_lr_final=1e-2),
    )
    trainer = toy_trainer(
        tmp_path, config, smooth(toy_capture(others=("nir",), aligned=aligned, thermal_kind="scalar"))
    )
    before, after = trainer.results.evaluate().metrics, trainer.train()
    for name in THREE:
        assert after[name]["psnr"] > before[name]["psnr"] + 1.0, name
    assert after["nir"]["mae_reflectance"] < 0.5 * before["nir"]["mae_reflectance"]
    assert after["thermal"]["mae_celsius"] < 0.5 * before["thermal"]["mae_celsius"]


@pytest.mark.slow  # fewer spectra train end to end above
def test_ten_spectra_train_from_beginning_to_end(tmp_path: Path) -> None:
    """They train, with Gaussians added, removed and reset, are judged one by one, exported, and go on to the bit."""
    config = toy_run_config(12, model={"feature_dim": 12}, spectra=ten_spectra())
    capture = many_frames(toy_capture(others=BANDS))
    trainer = toy_trainer(tmp_path / "whole", config, capture)
    metrics = trainer.train()
    assert metrics["spectra"] == list(TEN)
    assert all(metrics[name]["psnr"] > 4 for name in TEN)
    assert all(metrics[name]["mae_reflectance"] > 0 for name in BANDS)
    assert list(metrics["opacity_offsets_kept"]) == ["thermal", "band_2", "band_6"]
    assert metrics["num_gaussians"] != 60
    run = trainer.run
    assert sorted(path.name for path in run.ply.iterdir()) == sorted(f"splat_{name}.ply" for name in TEN)
    with (run.stats / "per_view.csv").open() as file:
        assert [row["spectrum"] for row in csv.DictReader(file)] == list(TEN)
    last = json.loads(run.metrics_jsonl.read_text().splitlines()[-2])
    assert {f"psnr_{name}" for name in TEN} < last.keys()
    assert {f"features_{name}" for name in TEN[:-2]} < last.keys()
    assert not {f"features_{name}" for name in TEN[-2:]} & last.keys()

    resumed = stopped_and_resumed(tmp_path / "half", config, capture, 7)
    while resumed.step < 12:
        resumed.train_step()
    assert_same_state(state_tensors(resumed), state_tensors(trainer))
    restored = SceneModel.from_checkpoint(load_checkpoint(run.checkpoint(12)), "cpu")
    views = trainer.frames[0].views
    with torch.no_grad():
        ours, theirs = (model.render(views, sh_degree=1).images for model in (trainer.model, restored))
    assert ours.keys() == set(TEN)
    assert all(torch.equal(ours[name], theirs[name]) for name in TEN)


def test_other_spectra_are_not_resumed(tmp_path: Path) -> None:
    """A run of three spectra goes on with these three alone, in their order."""
    config, capture = toy_run_config(4, spectra={"nir": {}}), many_frames(toy_capture(others=("nir", "red")))
    toy_trainer(tmp_path, config, capture).train()
    run = RunDirectory.open(tmp_path)
    assert Trainer.resume(config, capture, run).step == 4
    for spectra, left_out, said in (
        ({}, (), "rgb thermal"),
        ({"nir": {}}, ("nir",), "rgb thermal"),
        ({"nir": {}, "red": {}}, (), "rgb thermal nir red"),
        ({"red": {}, "nir": {}}, ("red", "rgb"), "thermal nir"),
    ):
        other = toy_run_config(4, spectra=spectra, without=left_out)
        with pytest.raises(UserError, match=f"trained with spectra=rgb thermal nir, the command asks for {said}."):
            Trainer.resume(other, capture, run)


def test_sets_start_from_one_another(tmp_path: Path) -> None:
    """Fine-tuning in a row: each set is a copy of the one before as training of its spectrum begins."""
    spectra = {
        "rgb": {"train_until": 0.25},
        "thermal": {"train_from": 0.25, "train_until": 0.5, "start": "rgb"},
        "nir": {"train_from": 0.5, "start": "thermal"},
    }
    config = toy_run_config(16, model=SEPARATE, spectra=spectra)
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture(others=("nir",))))

    def held(name: str) -> dict[str, torch.Tensor]:
        return {key: value.clone() for key, value in trainer.model.gaussians(name).state_dict().items()}

    start = held("nir")
    for steps, copy, source in ((4, "thermal", "rgb"), (8, "nir", "thermal")):
        while trainer.step < steps:
            trainer.train_step()
        ours, theirs = held(copy), held(source)
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
        assert len(trainer.state.strategies[copy].grad_norm_sum) == len(trainer.model.gaussians(copy))  # type: ignore[attr-defined]
        if steps == 4:
            assert all(torch.equal(value, start[key]) for key, value in held("nir").items())
    thermal = held("thermal")
    while trainer.step < 16:
        trainer.train_step()
    assert all(torch.equal(value, thermal[key]) for key, value in held("thermal").items())
    now = held("nir")
    assert now["sh0"].shape != thermal["sh0"].shape or not torch.equal(now["sh0"], thermal["sh0"])


def test_frames_of_any_two_spectra(tmp_path: Path) -> None:
    """Frames that lack one spectrum, another in each, train what they show; none of the three is forgotten."""
    capture = many_frames(toy_capture(others=("nir",), aligned=False), 7)
    frames = tuple(without(frame, THREE[index % 3]) for index, frame in enumerate(capture.train))
    spectra = {name: {"exposure": "affine"} for name in THREE}
    spectra["nir"]["opacity"] = "own"
    config = toy_run_config(12, spectra=spectra, log_every=1)
    trainer = toy_trainer(tmp_path, config, dataclasses.replace(capture, train=frames))
    metrics = trainer.train()
    assert metrics["steps"] == 12
    assert all(metrics[name]["psnr"] > 4 for name in THREE)
    lines = [json.loads(line) for line in trainer.run.metrics_jsonl.read_text().splitlines()]
    shown = [tuple(name for name in THREE if f"psnr_{name}" in line) for line in lines if "loss" in line]
    assert set(shown) == {("rgb", "thermal"), ("thermal", "nir"), ("rgb", "nir")}


def test_any_list_of_spectra_trains(tmp_path: Path) -> None:
    """Without RGB, without thermal, or of one band alone: the first of the list has α, whatever it is."""
    capture = many_frames(toy_capture(others=("nir", "red")))
    for spectra in (("nir",), ("nir", "red"), ("rgb", "nir"), ("thermal", "red")):
        left_out = tuple(name for name in (*THREE, "red") if name not in spectra)
        config = toy_run_config(7, spectra={"nir": {}, "red": {"opacity": "own"}}, without=left_out)
        trainer = toy_trainer(tmp_path / "_".join(spectra), config, capture)
        metrics = trainer.train()
        assert metrics["spectra"] == list(spectra)
        assert not {"rgb", "thermal", "nir", "red"} - set(spectra) & metrics.keys()
        second = ("red",) if spectra[-1] == "red" else ()
        assert trainer.model.gaussians("shared").second_opacities == second
        assert sorted(path.name for path in trainer.run.ply.iterdir()) == sorted(f"splat_{n}.ply" for n in spectra)
