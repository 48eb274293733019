"""Features and bands as spectra: learnt in a basis that is kept, asked by vectors, combined by formulas."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from stacked_toy import BASIS, CHANNELS, stacked
from thermosplat.errors import UserError
from thermosplat.runs.checkpoint_file import load_checkpoint
from thermosplat.scene.model import SceneModel
from thermosplat.spectra import LATENT
from toy_run import many_frames, toy_run_config, toy_sizes, toy_trainer
from toy_scene import toy_capture


@pytest.mark.parametrize(
    ("source", "score", "model"),
    [("features", "cosine", {}), ("bands", "psnr_bands", {}), ("bands", "psnr_bands", {"feature_dim": 0})],
)
def test_stacks_are_learnt_and_kept(tmp_path: Path, source: str, score: str, model: dict[str, Any]) -> None:
    """Training raises their score, and a checkpoint has their basis and renders the same."""
    config = toy_run_config(4, spectra={"stack": {"source": source, "channels": CHANNELS, "loss": 20.0}}, model=model)
    trainer = toy_trainer(tmp_path, config, stacked(many_frames(toy_capture())))
    frame, scene = trainer.frames[0], trainer.state.model

    def scored() -> float:
        image = scene.render(frame.views, sh_degree=1).images["stack"]
        return scene.formations["stack"].scores(image.detach(), frame.views["stack"].image, None)[score]

    before = scored()
    with toy_sizes():
        metrics = trainer.train()
    assert scored() > before
    assert score in metrics["stack"]
    restored = SceneModel.from_checkpoint(load_checkpoint(trainer.run.checkpoint(4)), "cpu")
    basis = restored.formations["stack"].basis_of_images()
    assert basis is not None
    np.testing.assert_array_equal(basis, BASIS)
    again, trained = (one.render(frame.views, sh_degree=1).images["stack"] for one in (restored, scene))
    torch.testing.assert_close(again, trained)
    assert scene.formations["stack"].behind(scene.background).shape == (LATENT + 1,)


def test_features_are_asked_by_a_vector() -> None:
    """The layer has the cosine of what was rendered and the vector; a vector of another length is refused."""
    config = toy_run_config(2, spectra={"stack": {"source": "features", "channels": CHANNELS}})
    model = SceneModel.from_capture(config, stacked(many_frames(toy_capture())), "cpu")
    formation = model.formations["stack"]
    assert formation.layers == ()
    assert formation.ask(torch.from_numpy(BASIS[1] * 5))
    assert formation.layers == ("query",)
    image = torch.full((1, 2, LATENT + 1), 0.5)
    image[0, 0, 1], image[0, 1, :2] = 0.9, torch.tensor([0.9, 0.9])
    rendered = model.render({}, sh_degree=0)
    rendered.images["stack"] = image
    torch.testing.assert_close(formation.layer("query", rendered), torch.tensor([[1.0, 0.5**0.5]]))
    for wrong in (torch.ones(CHANNELS + 1), torch.zeros(CHANNELS), torch.full((CHANNELS,), torch.nan)):
        with pytest.raises(UserError, match="stack is asked by 20 finite numbers"):
            formation.ask(wrong)
    assert not model.formations["rgb"].ask(torch.ones(CHANNELS))


def test_bands_are_combined() -> None:
    """A vegetation index of what was rendered; where it has no value it is 0."""
    derived = ("ndvi = (b2 - b1) / (b2 + b1)",)
    spectra = {"stack": {"source": "bands", "channels": CHANNELS, "derived": derived}}
    model = SceneModel.from_capture(toy_run_config(2, spectra=spectra), stacked(many_frames(toy_capture())), "cpu")
    formation = model.formations["stack"]
    assert formation.layers == ("ndvi",)
    assert formation.layer_range("ndvi") == (-1.0, 1.0)
    made = torch.randn(1, 2, LATENT)
    made[0, 1] = 0
    bands = (made @ torch.from_numpy(BASIS)).numpy()
    rendered = model.render({}, sh_degree=0)
    rendered.images["stack"] = torch.nn.functional.pad((made + 1) / 2, (0, 1))
    expected = (bands[0, 0, 1] - bands[0, 0, 0]) / (bands[0, 0, 1] + bands[0, 0, 0])
    np.testing.assert_allclose(formation.layer("ndvi", rendered), [[expected, 0.0]], rtol=1e-3)


def test_what_a_basis_leaves_out_is_no_error_of_a_scene() -> None:
    """The budget compares directions of features, of any length; noise outside the basis is shown by no render."""
    config = toy_run_config(2, spectra={"stack": {"source": "features", "channels": CHANNELS}})
    formation = SceneModel.from_capture(config, stacked(many_frames(toy_capture())), "cpu").formations["stack"]
    coordinates = torch.randn(2, 3, LATENT, generator=torch.Generator().manual_seed(0)) / 10
    truth = torch.cat([(coordinates + 1) / 2, torch.full((2, 3, 1), 0.8)], dim=-1)
    longer = torch.cat([(3 * coordinates + 1) / 2, torch.zeros(2, 3, 1)], dim=-1)
    torch.testing.assert_close(formation.graded_truth(longer), formation.graded_truth(truth))
