"""A linear decoder trains as the others do."""

from dataclasses import replace
from pathlib import Path

from toy_run import many_frames, toy_run_config, toy_trainer
from toy_scene import toy_capture


def test_a_linear_decoder_is_trained(tmp_path: Path) -> None:
    """Two steps move its weights."""
    config = toy_run_config(2)
    config = replace(config, decoder=replace(config.decoder, branches="linear", modulation=False))
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
    weight = trainer.model.formations.decoder.heads["thermal"].weight
    before = weight.detach().clone()
    trainer.train()
    assert (weight != before).any()
