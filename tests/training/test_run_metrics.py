"""What metrics.json says of a run."""

import json
from pathlib import Path

import torch
from toy_run import many_frames, toy_run_config, toy_trainer

from thermosplat.training.run_metrics import run_metrics
from toy_scene import toy_capture


def test_what_a_run_says_of_itself(tmp_path: Path) -> None:
    """Numbers of the evaluation as they are, the state's clock and counts, the model's size; all of it fits JSON."""
    state = toy_trainer(tmp_path, toy_run_config(), many_frames(toy_capture())).state
    state.step = 7
    state.seconds.train, state.seconds.wall, state.seconds.first_step = 3.0, 4.0, 0.5
    evaluated = {"rgb": {"psnr": 20.0}, "thermal": {"psnr": 30.0}, "per_view": []}
    found = run_metrics(evaluated, state, torch.device("cpu"), None)
    assert json.loads(json.dumps(found)) == found
    assert (found["rgb"], found["thermal"]) == (evaluated["rgb"], evaluated["thermal"])
    assert (found["steps"], found["train_seconds"], found["wall_seconds"], found["first_step_seconds"]) == (
        7,
        3,
        4,
        0.5,
    )
    assert found["num_gaussians"] == 60
    assert found["gaussians"] == {"shared": 60}
    assert found["model_bytes"] == state.model.num_bytes > 0
    assert found["thermal_offsets_kept"] == 0.0
    assert found["feature_channels"] == 8
    assert found["lpips_net"] is None
    assert found["device"].startswith("CPU")
