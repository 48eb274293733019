"""A capture trains alike in every world, and what leaves a training lies where the capture's poses say."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from moved_captures import UTM, WORLDS, write_moved
from thermosplat.datasets import load_capture
from thermosplat.datasets.placement import WORLD, Placement
from thermosplat.evaluation.held_out import evaluate
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.export.formats.ply import PROPERTIES
from thermosplat.runs.checkpoint import SavedModel
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer
from toy_run import toy_run_config, toy_trainer


class Outcome(NamedTuple):
    """What a short training leaves."""

    metrics: dict[str, Any]
    splats: np.ndarray
    """[N, 62], as the PLY of RGB has them."""
    trainer: Trainer


def trained(folder: Path, world: Placement) -> Outcome:
    """A dozen steps on the small capture in a world."""
    config = toy_run_config(12, data=str(write_moved(folder / "capture", world)))
    trainer = toy_trainer(folder / "run", config, load_capture(config.data))
    while trainer.step < 12:
        trainer.train_step()
    trainer.save()
    trainer.results.exporting()()
    metrics = evaluate(trainer.model, trainer.capture, sh_degree=trainer.sh_degree)
    content = (trainer.run.ply / "splat_rgb.ply").read_bytes().partition(b"end_header\n")[2]
    return Outcome(metrics, np.frombuffer(content, "<f4").reshape(-1, len(PROPERTIES)), trainer)


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The training in usual coordinates."""
    return trained(tmp_path_factory.mktemp("usual"), WORLD)


@pytest.mark.rotating
@pytest.mark.parametrize("name", WORLDS)
def test_a_capture_trains_alike_in_every_world(name: str, usual: Outcome, tmp_path: Path) -> None:
    """The same PSNR to rounding, and the PLY is that of usual coordinates, moved and scaled."""
    world, found = WORLDS[name], trained(tmp_path, WORLDS[name])
    for spectrum in ("rgb", "thermal"):
        assert found.metrics[spectrum]["psnr"] == pytest.approx(usual.metrics[spectrum]["psnr"], abs=2e-3)
    origin = np.zeros(3)
    if found.trainer.model.placement.is_moved:
        origin = np.array(json.loads((found.trainer.run.ply / "geo.json").read_text())["origin"])
        header = (found.trainer.run.ply / "splat_rgb.ply").read_bytes()[:400].decode("ascii", "replace")
        assert f"comment origin {' '.join(map(repr, origin.tolist()))}" in header
    else:
        assert not (found.trainer.run.ply / "geo.json").exists()
    assert len(found.splats) == len(usual.splats)
    positions, expected = found.splats[:, :3].astype(np.float64) + origin, world.to_world(usual.splats[:, :3])
    np.testing.assert_allclose(positions, expected, rtol=0, atol=1e-3 * world.unit)
    scales = [PROPERTIES.index(f"scale_{axis}") for axis in range(3)]
    np.testing.assert_allclose(found.splats[:, scales], usual.splats[:, scales] + np.log(world.unit), atol=1e-2)


def test_a_run_goes_on_in_its_own_frame(tmp_path: Path) -> None:
    """The checkpoint keeps it, and gives it to the capture that it is shown with; a new camera is the world's."""
    first = trained(tmp_path, WORLDS["UTM"]).trainer
    config = dataclasses.replace(first.recipe.asked, max_steps=13)
    again = Trainer.resume(config, load_capture(config.data), RunDirectory.open(first.run.path))
    assert again.capture.placement == again.model.placement == first.model.placement
    assert again.capture.placement.is_moved
    run = load_run(str(first.run.path), device="cpu")
    capture = run.capture(None)
    view = capture.train[0].views["rgb"]
    own = run.view(capture.placement.viewmat_to_world(view.viewmat), view.camera.K, 32, 24)
    torch.testing.assert_close(own.viewmat, torch.tensor(view.viewmat, dtype=torch.float32), rtol=0, atol=1e-6)
    assert (own.width, own.height, own.K[1, 1]) == (32, 24, view.camera.fy)


def test_old_checkpoints_have_the_worlds_frame(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A run of a version without frames goes on where it was, whatever its capture would be moved by today."""
    monkeypatch.setattr(Placement, "of", lambda centers, points: WORLD)
    first = trained(tmp_path, WORLDS["UTM"]).trainer
    monkeypatch.undo()
    path = first.run.latest_checkpoint()
    state = torch.load(path, weights_only=True)
    del state["model"]["placement"]
    torch.save(state, path)
    capture = load_capture(first.recipe.asked.data)
    assert capture.placement.is_moved
    again = Trainer.resume(first.recipe.asked, capture, RunDirectory.open(first.run.path))
    assert again.capture.placement == WORLD
    center = np.linalg.inv(again.capture.train[0].views["rgb"].viewmat)[:3, 3]
    assert np.linalg.norm(center - UTM) < 10
    assert load_run(str(first.run.path), device="cpu").capture(None).placement == WORLD
    assert SavedModel({}, None, {}).placement == {}
