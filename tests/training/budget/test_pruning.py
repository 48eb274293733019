"""The Gaussians that matter least go, as many as the images do not miss."""

import pytest
import torch

from thermosplat.training.budget.image_change import ImageChange
from thermosplat.training.budget.pruning import dispensable, least, prune_sets
from thermosplat.training.optimizers import gaussian_optimizers
from toy_scene import toy_capture, toy_config, toy_frame, toy_model


def test_a_number_of_the_least() -> None:
    """The smallest scores, the first of equal ones."""
    scores = torch.tensor([0.5, 0.01, 0.4, 0.03, 0.03])
    assert least(scores, 0).tolist() == [False] * 5
    assert least(scores, 2).tolist() == [False, True, False, True, False]


def test_as_many_go_as_images_do_not_miss() -> None:
    """What is invisible goes at no tolerance; with more, more goes, least first, and the images change within it."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    frame, gaussians = toy_frame(capture), model.gaussians("shared")
    with torch.no_grad():
        gaussians.logit_opacities[:10] = -20.0
        gaussians.thermal_opacity_offsets[:10] = 0.0
    scores = torch.arange(60.0)
    before = {name: value.detach().clone() for name, value in gaussians.named_parameters()}
    change = ImageChange(model, [frame], 1)
    removed = {tolerance: dispensable(gaussians, scores, change, tolerance) for tolerance in (0.0, 0.02, 1e9)}
    assert all(torch.equal(before[name], value) for name, value in gaussians.named_parameters())
    counts = [int(mask.sum()) for mask in removed.values()]
    assert 10 <= counts[0] < counts[1] < counts[2] == 59
    assert torch.equal(removed[0.02], scores < counts[1])
    prune_sets({"shared": gaussians}, _optimizers(model), {"shared": removed[0.02]})
    assert 0 < change.now() <= 0.02


def test_gaussians_of_one_spectrum_are_missed_in_it() -> None:
    """Those that thermal images alone show do not go without a change of these."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    gaussians = model.gaussians("shared")
    with torch.no_grad():
        gaussians.logit_opacities.fill_(-20.0)
        gaussians.thermal_opacity_offsets.fill_(20.0)
    change = ImageChange(model, [toy_frame(capture)], 1)
    assert dispensable(gaussians, torch.arange(60.0), change, 1e-6).sum() < 59


@pytest.mark.parametrize("opacity", ["offset", "own"])
def test_gaussians_of_a_third_spectrum_are_missed_in_it(opacity: str) -> None:
    """Those that near infrared alone shows stay, however its opacity is stored; all opacities come back."""
    capture = toy_capture(others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {"opacity": opacity}}), capture)
    gaussians, everyone = model.gaussians("shared"), torch.arange(60)
    faint = torch.full((60,), -20.0)
    clear = faint.masked_fill(everyone < 30, 1.0)
    gaussians.set_opacity_logits(everyone, faint, {"thermal": faint, "nir": clear})
    before = {name: value.detach().clone() for name, value in gaussians.named_parameters()}
    change = ImageChange(model, [toy_frame(capture)], 1)
    removed = dispensable(gaussians, torch.arange(60.0).flip(0), change, 1e-6)
    assert removed[30:].all()
    assert not removed[:30].all()
    assert all(torch.equal(before[name], value) for name, value in gaussians.named_parameters())


def test_no_set_is_emptied() -> None:
    """Pruning all of a set leaves it as it is."""
    model = toy_model(toy_config(), toy_capture())
    gaussians = model.gaussians("shared")
    some = torch.arange(len(gaussians)) < 7
    prune_sets({"shared": gaussians}, _optimizers(model), {"shared": some})
    assert len(gaussians) == len(some) - 7
    prune_sets({"shared": gaussians}, _optimizers(model), {"shared": torch.ones(len(gaussians), dtype=torch.bool)})
    assert len(gaussians) == len(some) - 7


def _optimizers(model):  # type: ignore[no-untyped-def]
    return {"shared": gaussian_optimizers(model.gaussians("shared"), toy_config().optimizer)}
