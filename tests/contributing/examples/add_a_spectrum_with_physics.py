"""Air is learnt with the scene, and comes back with it."""

from pathlib import Path

from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.scene.model import SceneModel
from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture


def test_air_is_learnt_and_kept(tmp_path: Path) -> None:
    """Two steps move its density; metrics.json and the checkpoint have it."""
    config = toy_run_config(2, spectra={"thermal": {"haze": 0.1}})
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
    found = trainer.train()["formations"]["thermal"]["haze"]
    assert 0 < abs(found - 0.1) < 0.05
    restored = SceneModel.from_checkpoint(load_checkpoint(trainer.run.checkpoint(2)), "cpu")
    assert restored.formations["thermal"].numbers() == {"haze": found}
