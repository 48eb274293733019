"""What metrics.json says of a run."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.training.session.run_metrics import run_metrics
from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture


def test_what_a_run_says_of_itself(tmp_path: Path) -> None:
    """Numbers of the evaluation as they are, the state's clock and counts, the model's size; all of it fits JSON."""
    state = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture())).state
    state.step = 7
    state.seconds.train, state.seconds.wall, state.seconds.first_step = 3.0, 4.0, 0.5
    evaluated = {"rgb": {"psnr": 20.0}, "thermal": {"psnr": 30.0}, "spectra": ["rgb", "thermal"], "num_gaussians": 60}
    found = run_metrics(evaluated, state, torch.device("cpu"), None, toy_run_config(lens="direct", scenes=2))
    assert json.loads(json.dumps(found)) == found
    assert (found["rgb"], found["thermal"]) == (evaluated["rgb"], evaluated["thermal"])
    assert (found["steps"], found["train_seconds"], found["wall_seconds"], found["first_step_seconds"]) == (
        7,
        3,
        4,
        0.5,
    )
    assert found["spectra"] == ["rgb", "thermal"]
    assert found["num_gaussians"] == state.model.num_gaussians == 60
    assert found["gaussians"] == {"shared": 60}
    assert found["model_bytes"] == state.model.num_bytes > 0
    assert found["opacity_offsets_kept"] == {"thermal": 0.0}
    assert not any(found["formations"].values())
    assert found["feature_channels"] == 8
    assert found["lens"] == "direct"
    assert found["scenes"] == 2
    assert found["lpips_net"] is None
    assert found["device"].startswith("CPU")


def test_offsets_of_every_spectrum(tmp_path: Path) -> None:
    """The share of offsets that are left, of spectra that have offsets; own logits and shared opacities have none.

    And how far cameras blur, of those that do.
    """
    spectra: dict[str, dict[str, Any]] = {
        "thermal": {"point_spread": 0.02},
        "nir": {"opacity": "offset"},
        "red": {"opacity": "own"},
    }
    capture = many_frames(toy_capture(others=("nir", "red", "blue")))
    state = toy_trainer(tmp_path, toy_run_config(spectra=spectra | {"blue": {}}), capture).state
    with torch.no_grad():
        state.gaussian_sets["shared"].nir_opacity_offsets[:15] = 0.5
    found = run_metrics({}, state, torch.device("cpu"), None, toy_run_config())
    assert found["opacity_offsets_kept"] == {"thermal": 0.0, "nir": 0.25}
    assert found["formations"].pop("thermal") == pytest.approx({"point_spread": 0.02})
    assert not any(found["formations"].values())
