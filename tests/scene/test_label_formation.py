"""Labels as a spectrum: learnt by their cross-entropy, shown in the colours of classes, judged by their overlap."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from labelled_toy import LABELS, labelled_capture
from thermosplat.class_colors import colors_of, numbers_of
from thermosplat.config import LossConfig
from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.scene.formations.formation import LossTerm
from thermosplat.scene.model import SceneModel
from toy_run import toy_run_config, toy_sizes, toy_trainer
from toy_scene import toy_model

WITHOUT_FEATURES: dict[str, Any] = {"model": {"feature_dim": 0}}


def colored(numbers: torch.Tensor) -> torch.Tensor:
    return torch.stack(colors_of(numbers), dim=-1) / 255.0


def test_every_class_has_a_color_of_its_own() -> None:
    """256 numbers are 256 colours, and these the numbers again."""
    numbers = torch.arange(256)
    colors = torch.stack(colors_of(numbers), dim=-1)
    assert len(colors.unique(dim=0)) == 256
    torch.testing.assert_close(numbers_of(*colors.T), numbers)


@pytest.mark.parametrize("how", [{}, WITHOUT_FEATURES], ids=["features", "harmonics"])
def test_labels_are_learnt_kept_and_judged(tmp_path: Path, how: dict[str, Any]) -> None:
    """Training lowers their loss; eval has overlaps and temperatures by class; a checkpoint renders the same."""
    config = toy_run_config(4, spectra={"labels": {**LABELS, "loss": 20.0}, **opacities(how)}, **how)
    trainer = toy_trainer(tmp_path, config, labelled_capture())
    frame, model = trainer.frames[0], trainer.state.model

    def loss() -> float:
        rendered = model.render(frame.views, sh_degree=1)
        formation, view = model.formations["labels"], frame.views["labels"]
        (term,) = formation.losses(rendered, view, config.spectra["labels"], LossConfig())
        assert isinstance(term, LossTerm)
        return term.loss.item()

    before = loss()
    with toy_sizes():
        metrics = trainer.train()
    assert loss() < before
    assert 0 <= metrics["labels"]["miou"] <= 1
    assert {"iou_wall", "iou_window", "iou_door"} <= metrics["labels"].keys()
    by_class = metrics["classes"]["labels"]
    assert sum(found["thermal"]["pixels"] for found in by_class.values()) == 24 * 18
    assert all(10 <= found["thermal"]["lowest"] <= found["thermal"]["highest"] <= 30 for found in by_class.values())
    restored = SceneModel.from_checkpoint(load_checkpoint(trainer.run.checkpoint(4)), "cpu")
    again = restored.render(frame.views, sh_degree=1).images["labels"]
    trained = model.render(frame.views, sh_degree=1).images["labels"]
    torch.testing.assert_close(again, trained)
    assert model.formations["labels"].behind(model.background).shape == (3,)
    assert set(numbers_of(*(again * 255).round().long().unbind(-1)).unique().tolist()) <= {0, 1, 2}


def opacities(how: dict[str, Any]) -> dict[str, Any]:
    """Without features, an opacity each, as MMOne has it."""
    return {"thermal": {"opacity": "own"}} if how else {}


def test_mmone_divides_gaussians_of_three_modalities(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With labels as the third, what is divided is seen by one of the three alone."""
    monkeypatch.setattr("thermosplat.training.density.decomposition.CONFLICT_THRESHOLD", 1e-7)
    spectra = {"labels": {**LABELS, "opacity": "own"}, "thermal": {"opacity": "own"}}
    config = toy_run_config(4, spectra=spectra, **WITHOUT_FEATURES)
    config = dataclasses.replace(
        config, densification=dataclasses.replace(config.densification, strategy="decomposing")
    )
    trainer = toy_trainer(tmp_path, config, labelled_capture())
    before = trainer.state.model.num_gaussians
    with toy_sizes():
        trainer.train()
    gaussians = trainer.state.model.gaussians("shared")
    seen = torch.stack([gaussians.opacities_in(name) > 1 / 255 for name in ("rgb", "thermal", "labels")])
    alone = seen.sum(dim=0) == 1
    assert len(gaussians) > before
    assert seen[:, alone].any(dim=1).all()


def test_pixels_without_a_class_do_not_count() -> None:
    """Neither the loss nor the overlaps see what a mask hides, nor a colour that is a mean of two classes."""
    config = toy_run_config(2, spectra={"labels": LABELS})
    model = toy_model(config, capture := labelled_capture())
    formation = model.formations["labels"]
    frame = frame_tensors(capture.train[0], capture.scales, "cpu")
    rendered, view = model.render(frame.views, sh_degree=1), frame.views["labels"]

    def loss(image: torch.Tensor) -> float:
        changed = dataclasses.replace(view, image=image)
        (term,) = formation.losses(rendered, changed, config.spectra["labels"], LossConfig())
        assert isinstance(term, LossTerm)
        return term.loss.item()

    hidden, mixed = view.image.clone(), view.image.clone()
    hidden[:2] = colored(torch.tensor(2))
    assert loss(hidden) == loss(view.image)
    mixed[5, 5] = colored(torch.tensor([0, 1])).mean(dim=0)
    assert formation.classes_in(mixed)[5, 5] == -1
    assert loss(mixed) != loss(view.image)
    assert math.isfinite(loss(torch.full_like(view.image, 0.3)))


def test_overlap_of_images() -> None:
    """Half of the window is taken for wall, and there is no door."""
    formation = toy_model(toy_run_config(2, spectra={"labels": LABELS}), labelled_capture()).formations["labels"]
    true, found = torch.tensor([[0, 0, 1, 1]]), torch.tensor([[0, 0, 0, 1]])
    scores = formation.scores(colored(found), colored(true), None)
    assert scores["iou_wall"] == pytest.approx(2 / 3)
    assert scores["iou_window"] == pytest.approx(1 / 2)
    assert math.isnan(scores["iou_door"])
    assert scores["miou"] == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert formation.scores(colored(found), colored(true), true == 0)["iou_wall"] == 1.0
