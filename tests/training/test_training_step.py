"""What the host decides about a step."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from thermosplat.config import DensificationConfig, LossConfig
from thermosplat.training.density.gaussian_ops import prune
from thermosplat.training.optimizers import gaussian_optimizers
from thermosplat.training.step_kind import StepKind, sh_degree_at
from toy_run import many_frames, step_gradients, toy_run_config, toy_trainer
from toy_scene import toy_capture


def test_sh_degree_rises_with_the_steps() -> None:
    """One more degree every interval, up to the configured one: as gsplat, from the step after the interval on."""
    config = toy_run_config()  # interval 4, degree 1
    assert [sh_degree_at(config, step) for step in (0, 1, 4, 5, 8, 9, 12)] == [0, 0, 0, 1, 1, 1, 1]


def test_depths_are_drawn_together_late(tmp_path: Path) -> None:
    """In the second half the spread of depths is a loss, and only then."""
    config = toy_run_config(max_steps=8, log_every=1)
    loss = dataclasses.replace(config.loss, depth_spread=0.1)
    config = dataclasses.replace(config, loss=loss)
    assert [StepKind.at(config, step).depth_spread for step in (1, 4, 5, 8)] == [0, 0, 1, 1]
    assert not StepKind.at(toy_run_config(), 12).depth_spread
    toy_trainer(tmp_path, config, many_frames(toy_capture())).train()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "depth_spread" in line] == [5, 6, 7, 8]


def test_penalties_leave_alone_what_a_step_does_not_train(tmp_path: Path) -> None:
    """RGB Gaussians that are kept while thermal ones are fine-tuned, and thermal ones before, do not fade or shrink."""
    config = toy_run_config(
        8,
        model={"gaussian_sets": "separate", "feature_dim": 0},
        spectra={"rgb": {"train_until": 0.5}, "thermal": {"train_from": 0.5}},
        loss=LossConfig(opacity_reg=0.01, scale_reg=0.01),
        densification=DensificationConfig(stop_step=0),
    )
    trainer = toy_trainer(tmp_path, config, many_frames(toy_capture()))
    for kept, steps in (("thermal", 4), ("rgb", 8)):
        before = {name: value.clone() for name, value in trainer.model.gaussians(kept).state_dict().items()}
        while trainer.step < steps:
            trainer.train_step()
        after = trainer.model.gaussians(kept).state_dict()
        assert all(torch.equal(value, after[name]) for name, value in before.items())


def test_terms_have_their_weights(tmp_path: Path) -> None:
    """Twice the weight is twice the term; balanced, a spectrum's terms are those of the other set's share."""
    capture = many_frames(toy_capture())

    def losses(name: str, loss: LossConfig, **model: Any) -> dict[str, float]:
        config = toy_run_config(model=model, loss=loss)
        trainer = toy_trainer(tmp_path / name, config, capture)
        first = trainer.model.gaussians(next(iter(trainer.model.gaussian_sets)))
        prune(first, gaussian_optimizers(first, config.optimizer), torch.arange(60) < 20)  # of two sets, 40 and 60
        kind = StepKind(1, densifying=False, depth_spread=loss.depth_spread > 0)
        done = step_gradients(trainer, kind)
        return {term: value.item() for term, value in done.losses.items()}

    once = losses("once", LossConfig(feature_norm=0.1, depth_spread=0.2))
    twice = losses("twice", LossConfig(feature_norm=0.2, depth_spread=0.4))
    for term in ("feature_norm", "depth_spread"):
        assert once[term] > 0
        assert twice[term] == pytest.approx(2.0 * once[term])
    assert twice["rgb"] == once["rgb"]
    separate = {"gaussian_sets": "separate", "feature_dim": 0}
    plain, balanced = (losses(str(on), LossConfig(balance=on), **separate) for on in (False, True))
    factors = {"rgb": 0.6, "thermal": 0.4, "thermal_smoothness": 0.4}
    assert balanced == pytest.approx({term: factors[term] * value for term, value in plain.items()})


def test_terms_of_three_sets_have_the_others_shares(tmp_path: Path) -> None:
    """Balanced, a spectrum's terms are multiplied by the mean share of the other sets: of 40, 60 and 60 Gaussians."""
    capture = many_frames(toy_capture(others=("nir",)))
    found = []
    for balance in (False, True):
        config = toy_run_config(
            model={"gaussian_sets": "separate", "feature_dim": 0},
            spectra={"nir": {"smoothness": 0.1}},
            loss=LossConfig(balance=balance),
        )
        trainer = toy_trainer(tmp_path / str(balance), config, capture)
        first = trainer.model.gaussians("rgb")
        prune(first, gaussian_optimizers(first, config.optimizer), torch.arange(60) < 20)
        kind = StepKind(1, densifying=False)
        done = step_gradients(trainer, kind)
        found.append({term: value.item() for term, value in done.losses.items()})
    plain, balanced = found
    shares = {"rgb": 120 / 160 / 2, "thermal": 100 / 160 / 2, "nir": 100 / 160 / 2}
    assert list(plain) == ["rgb", "thermal", "nir", "thermal_smoothness", "nir_smoothness"]
    expected = {term: shares[term.removesuffix("_smoothness")] * value for term, value in plain.items()}
    assert balanced == pytest.approx(expected)
