"""How much images change, against their error, and how much may be left out."""

import pytest
import torch

from labelled_toy import LABELS, labelled_capture
from thermosplat.datasets.frame_tensors import frame_tensors
from thermosplat.training.budget.image_change import ImageChange, most_within
from thermosplat.training.budget.opacity_sensitivities import opacity_sensitivities
from toy_scene import render, toy_capture, toy_config, toy_frame, toy_model


def test_change_is_measured_against_the_error() -> None:
    """Nothing changed: 0. Otherwise the squared change over the squared error, of the spectrum that changed more."""
    capture = toy_capture()
    model = toy_model(toy_config(), capture)
    frame = toy_frame(capture)
    with torch.no_grad():
        model.gaussians("shared").sh0 += 1.0
    before = model.render(frame.views, sh_degree=1)
    assert (before.images["rgb"] > 1.0).any()  # saturated: what is above does not show
    change = ImageChange(model, [frame, frame], 1)
    assert change.now() == 0.0
    with torch.no_grad():
        model.gaussians("shared").sh0 += 0.1
        model.gaussians("shared").features += 0.01
    after = model.render(frame.views, sh_degree=1)
    expected = {}
    for name, view in frame.views.items():
        old, new = (rendered.images[name].detach().clamp(0, 1) for rendered in (before, after))
        error = (old - view.image).square().mean().item()
        assert change.errors[name] == pytest.approx(error, rel=1e-5)
        expected[name] = (new - old).square().mean().item() / error
    assert change.now() == pytest.approx(expected["rgb"], rel=1e-4)
    assert expected["rgb"] > expected["thermal"] > 0


def test_supervised_channels_are_images_too() -> None:
    """Those asked for are compared with what losses compare them with, although no image shows them."""
    capture = toy_capture()
    model, frame = toy_model(toy_config(), capture), toy_frame(capture)
    assert model.formations.decoder is not None
    with torch.no_grad():
        for parameter in model.formations.decoder.parameters():
            parameter.zero_()
    losses = toy_config(spectra={"rgb": {"features": 0.0}})
    images, with_channel = ImageChange(model, [frame], 1), ImageChange(model, [frame], 1, losses)
    assert with_channel.errors.keys() == {"rgb", "thermal", "features_thermal"}

    def channel() -> torch.Tensor:
        features = model.render(frame.views, sh_degree=1).features["thermal"]
        return features.detach()[..., 3].clamp(0, 1)

    before = channel()
    with torch.no_grad():
        model.gaussians("shared").features[:, 3] += 0.1
    error = (before - frame.views["thermal"].intensity).square().mean().item()
    assert with_channel.errors["features_thermal"] == pytest.approx(error, rel=1e-5)
    assert images.now() == 0.0
    assert with_channel.now() == pytest.approx((channel() - before).square().mean().item() / error, rel=1e-4)


def test_the_spectrum_that_changed_most_counts() -> None:
    """Of three, each against its own error; and of their latent channels, each against its own intensity."""
    capture = toy_capture(others=("nir",))
    config = toy_config(spectra={"nir": {"opacity": "own"}})
    model, frame = toy_model(config, capture), toy_frame(capture)
    change = ImageChange(model, [frame], 1, config)
    channels = {"features_rgb", "features_thermal", "features_nir"}
    assert change.errors.keys() == {"rgb", "thermal", "nir"} | channels
    before = render(model, frame)
    with torch.no_grad():
        model.gaussians("shared").logit_nir_opacities -= 1.0  # no other image shows it
    after = render(model, frame)
    shares = {}
    for name, old, new, target in (
        ("nir", before.images["nir"], after.images["nir"], frame.views["nir"].image),
        ("features_nir", before.features["nir"], after.features["nir"], frame.views["nir"].image),
    ):
        if name == "features_nir":
            old, new = old[..., 4:5], new[..., 4:5]
        old, new = old.detach().clamp(0, 1), new.detach().clamp(0, 1)
        error = (old - target).square().mean().item()
        assert change.errors[name] == pytest.approx(error, rel=1e-5)
        shares[name] = (new - old).square().mean().item() / error
    assert min(shares.values()) > 0
    assert change.now() == pytest.approx(max(shares.values()), rel=1e-4)
    assert ImageChange(model, [frame.only(("rgb", "thermal"))], 1).errors.keys() == {"rgb", "thermal"}


@pytest.mark.parametrize("tolerance", [0.0, 0.4, 1.0, 7.0])
def test_the_largest_number_within_a_tolerance(tolerance: float) -> None:
    """The largest number whose change is within; the model is left with it."""

    class Linear:
        made = -1

        def now(self) -> float:
            return self.made / 100

        def apply(self, number: int) -> None:
            self.made = number

    change = Linear()
    found = most_within(change, 250, change.apply, tolerance)  # type: ignore[arg-type]
    assert found == change.made == min(round(100 * tolerance), 250)


def test_labels_change_with_their_probabilities() -> None:
    """A change that flips no class counts a little; classes that flip are no leap."""
    capture = labelled_capture()
    model = toy_model(toy_config(spectra={"labels": LABELS}), capture)
    frame = frame_tensors(capture.train[0], capture.scales, "cpu").only(("labels",))
    change = ImageChange(model, [frame], 1)
    shown = model.render(frame.views, sh_degree=1).images["labels"]
    with torch.no_grad():
        model.gaussians("shared").features += 1e-4
    assert torch.equal(model.render(frame.views, sh_degree=1).images["labels"], shown)
    assert 0 < change.now() < 1e-4
    found = opacity_sensitivities(model, [frame], 1, {"labels": 1.0})
    assert found["shared"].sum() > 0
