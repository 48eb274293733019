"""Gaussians of a checkpoint are those that were saved, or an error that names the tensor that does not fit."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from thermosplat.errors import UserError
from thermosplat.runs.checkpoint import Checkpoint, SavedModel, SavedTraining
from thermosplat.scene.model import SceneModel
from thermosplat.scene.saved_gaussians import num_not_finite
from toy_scene import toy_capture, toy_config, toy_model

CAPTURE = toy_capture()
CONFIG = toy_config()
MODEL = toy_model(CONFIG, CAPTURE)


def _checkpoint(model: SavedModel) -> Checkpoint:
    return Checkpoint(3, CONFIG, 1, model, {}, SavedTraining())


def _edited(change: Callable[[dict[str, Tensor]], Any]) -> SavedModel:
    saved = MODEL.checkpoint_state()
    sets = {name: dict(values) for name, values in saved.gaussian_sets.items()}
    change(sets["shared"])
    return SavedModel(sets, saved.decoders, saved.color_spaces)


def test_what_was_saved_comes_back() -> None:
    """Every parameter, equal to the last bit."""
    restored = SceneModel.from_checkpoint(_checkpoint(MODEL.checkpoint_state()), "cpu")
    saved, found = MODEL.state_dict(), restored.state_dict()
    assert saved.keys() == found.keys()
    assert all(torch.equal(saved[name], found[name]) for name in saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.update(logit_opacities=p["logit_opacities"][:5]), "logit_opacities has the shape"),
        (lambda p: p.update(means=p["means"][:, :2]), "means has the shape"),
        (lambda p: p.update(quats=p["quats"][:, :3]), "quats has the shape"),
        (lambda p: p.update(sh0=p["sh0"][0]), "sh0 has the shape"),
        (lambda p: p.update(features=p["features"][:, :3]), "features has the shape"),
        (lambda p: p.update(features=p["features"].double()), "features holds torch.float64"),
        (lambda p: p.update(means=torch.tensor(3.0)), "len"),
        (lambda p: p.pop("features"), "KeyError: 'features'"),
        (lambda p: p.pop("thermal_opacity_offsets"), "KeyError: 'thermal_opacity_offsets'"),
        (lambda p: p.update(colors=p["means"]), "no parameter colors"),
        (lambda p: p.update(feature_basis=torch.eye(3)), "feature_basis has the shape"),
    ],
)
def test_tensors_that_do_not_fit_are_refused(change: Callable[[dict[str, Tensor]], Any], message: str) -> None:
    """Shapes and types are held against the other tensors and the configuration, before anything is rendered."""
    with pytest.raises(UserError, match=f"its model cannot be used .*{message}"):
        SceneModel.from_checkpoint(_checkpoint(_edited(change)), "cpu")


def test_decoders_of_another_size_are_refused_before_memory_is_taken() -> None:
    """A configuration that asks for a network of terabytes, which the file does not hold."""
    huge = toy_config(decoder={"hidden_dim": 2**20})
    saved = MODEL.checkpoint_state()
    with pytest.raises(UserError, match=r"formations\.decoder\.shared_encoder\.0\.weight has the shape"):
        SceneModel.from_checkpoint(Checkpoint(3, huge, 1, saved, {}, SavedTraining()), "cpu")
    nothing = SavedModel(saved.gaussian_sets, None, saved.color_spaces)
    with pytest.raises(UserError, match=r"formations\.decoder\.shared_encoder\.0\.weight has the shape None"):
        SceneModel.from_checkpoint(_checkpoint(nothing), "cpu")


def test_a_blur_may_be_missing_where_noise_keeps_it_from_being_learnt() -> None:
    """Elsewhere the file is damaged."""
    saved = MODEL.checkpoint_state()  # of a model without a blur
    for by_noise in (False, True):
        thermal = {"point_spread": 0.05, "by_noise": by_noise}
        checkpoint = Checkpoint(3, toy_config(spectra={"thermal": thermal}), 1, saved, {}, SavedTraining())
        if by_noise:
            assert SceneModel.from_checkpoint(checkpoint, "cpu").formations.found("point_spread") == {}
        else:
            with pytest.raises(UserError, match=r"by_spectrum\.thermal\.point_spread\.log_width has the shape None"):
                SceneModel.from_checkpoint(checkpoint, "cpu")


def test_values_that_are_not_finite_are_counted() -> None:
    """One NaN or infinity in any parameter makes a Gaussian one that is not drawn."""
    model = SceneModel.from_checkpoint(_checkpoint(MODEL.checkpoint_state()), "cpu")
    gaussians = model.gaussians("shared")
    assert num_not_finite(gaussians) == 0
    with torch.no_grad():
        gaussians.means[3, 1] = torch.nan
        gaussians.features[3, 0] = torch.nan
        gaussians.logit_opacities[7] = torch.inf
    assert num_not_finite(gaussians) == 2
