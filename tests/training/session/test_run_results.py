"""What a training makes of its model, in the middle and at the end."""

import dataclasses
import json
from pathlib import Path

import pytest

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.geo_file import GeoFrame, read_geo
from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture


@pytest.fixture(scope="module")
def capture() -> Capture:
    """Four training frames and a held-out one."""
    return many_frames(toy_capture())


def test_an_evaluation_is_lacking_until_its_numbers_are_there(tmp_path: Path, capture: Capture) -> None:
    """Only of a step that was to be evaluated, in the middle of a run."""
    trainer = toy_trainer(tmp_path, toy_run_config(max_steps=8, eval_steps=(4, 8)), capture)
    lacking = []
    for step in (0, 3, 4, 8):
        trainer.state.step = step
        lacking.append(trainer.results.lack_evaluation())
    assert lacking == [False, False, True, False]
    trainer.state.step = 4
    trainer.results.evaluate()
    assert not trainer.results.lack_evaluation()


def test_strips_and_numbers_per_view_are_of_the_end(tmp_path: Path, capture: Capture) -> None:
    """An evaluation in the middle leaves its means alone; metrics.json is the last file of all."""
    trainer = toy_trainer(tmp_path, toy_run_config(max_steps=8, eval_steps=(4,)), capture)
    run, trainer.state.step = trainer.run, 4
    trainer.results.evaluate()
    assert [path.name for path in run.stats.iterdir()] == ["step_000004.json"]
    assert not any(run.renders.iterdir())
    judged = trainer.results.evaluate(at_the_end=True)
    assert (run.stats / "per_view.csv").is_file()
    assert any(run.renders.iterdir())
    assert not run.metrics_json.exists()
    metrics = trainer.results.write(judged)
    assert metrics["steps"] == 4
    assert metrics["rgb"] == judged.metrics["rgb"]
    assert run.metrics_json.is_file()


def test_a_run_keeps_where_its_capture_lies(tmp_path: Path, capture: Capture) -> None:
    """geo.json in the result folder is the capture's; the splats that training writes lie in UTM from the origin."""
    geo = GeoFrame(47.0512, 8.3064, 452.0, 0.8, 4)
    trainer = toy_trainer(tmp_path, toy_run_config(max_steps=1), dataclasses.replace(capture, geo=geo))
    trainer.train()
    assert read_geo(tmp_path) == geo
    told = json.loads((tmp_path / "ply" / "geo.json").read_text())
    assert told["origin"] == [447_319.0, 5_211_087.0, 452.0]
    assert told["epsg"] == 32632
