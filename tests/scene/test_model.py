"""The scene model: what is rendered from what, ablation switches, gradients, and restoring."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from rolling_captures import shaken
from thermosplat.datasets.cameras import LensCoefficients
from thermosplat.errors import UserError
from thermosplat.fused.point_spread import blurred_by_gaussian
from thermosplat.runs.checkpoint import Checkpoint, SavedTraining
from thermosplat.scene.model import SceneModel
from toy_run import through
from toy_scene import count_calls, largest_gradients, render, toy_capture, toy_config, toy_frame, toy_model

APART = [["rgb"], ["thermal"]]
"""Each spectrum by a call of its own."""


def test_aligned_frame_is_one_traversal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two views of one camera cost one call; images, features and opacities come out of it."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    calls = count_calls(monkeypatch)
    rendered = render(model, frame)
    assert calls == ["rasterization_rgbt"]
    assert rendered.images["rgb"].shape == rendered.images["thermal"].shape == (18, 24, 3)
    assert rendered.features["rgb"].shape == rendered.features["thermal"].shape == (18, 24, 8)
    assert rendered.alphas["rgb"].shape == rendered.alphas["thermal"].shape == (18, 24, 1)
    assert len(rendered.infos["shared"]) == 1
    assert not torch.allclose(rendered.alphas["rgb"], rendered.alphas["thermal"])


def test_single_views_equal_the_joint_traversal() -> None:
    """RGB alone and thermal alone give the images of the joint call, and leave the other spectrum out."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    both = render(model, frame)
    rgb, thermal = render(model, frame, only=("rgb",)), render(model, frame, only=("thermal",))
    apart = render(model, frame, shared_cameras=APART)
    for name, alone in (("rgb", rgb), ("thermal", thermal)):
        for kind in ("images", "features", "alphas"):
            assert list(getattr(alone, kind)) == [name]
            expected = getattr(both, kind)[name]
            torch.testing.assert_close(getattr(alone, kind)[name], expected, atol=2e-6, rtol=1e-5)
            torch.testing.assert_close(getattr(apart, kind)[name], expected, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("padding", [0.0, 0.1])
@pytest.mark.parametrize("branches", ["joined", "separate"])
@pytest.mark.parametrize("kind", ["scalar", "color"])
def test_a_decoder_starts_near_the_end_of_the_range_at_which_images_lie(
    kind: str, branches: str, padding: float
) -> None:
    """Of thermal images that are nearly black a decoder makes 0.1 where features are 0; of grey ones, grey."""
    capture = toy_capture(thermal_kind=kind)
    (frame,) = capture.train
    image = frame.views["thermal"].image
    black = dataclasses.replace(frame.views["thermal"], image=np.full_like(image, 0.02 if kind == "scalar" else 5))
    dark = dataclasses.replace(capture, train=(dataclasses.replace(frame, views={**frame.views, "thermal": black}),))
    decoder = {"branches": branches, "modulation": branches == "joined", "padding": padding}
    grey, made = (toy_model(toy_config(decoder=decoder), one) for one in (capture, dark))
    networks = made.formations.decoder
    last = networks.last_layer("thermal")
    shown = (1.0 + 2.0 * padding) * torch.sigmoid(last.bias) - padding
    torch.testing.assert_close(shown, torch.full_like(shown, 0.1), rtol=1e-4, atol=0.0)
    others = grey.state_dict()
    changed = [name for name, value in made.state_dict().items() if not torch.equal(value, others[name])]
    assert len(changed) == 1
    assert changed[0].endswith("bias")
    assert changed[0].startswith("formations.decoder")


@pytest.mark.parametrize("branches", ["joined", "separate"])
def test_a_camera_that_blurs(branches: str) -> None:
    """Features of its spectrum are blurred before they are decoded, in photographs SH colours, too; others stay."""
    capture, decoder = toy_capture(), {"branches": branches, "modulation": branches == "joined"}
    frame, sharp = toy_frame(capture), render(toy_model(toy_config(decoder=decoder), capture), toy_frame(capture))
    model = toy_model(toy_config(decoder=decoder, spectra={"thermal": {"point_spread": 0.05}}), capture)
    rendered = render(model, frame)
    torch.testing.assert_close(rendered.images["rgb"], sharp.images["rgb"])
    blurred = blurred_by_gaussian(sharp.features["thermal"], torch.tensor(0.05 * 24), radius=5)
    torch.testing.assert_close(rendered.features["thermal"], blurred)
    decoded = model.formations.decoder.image("thermal", blurred)
    torch.testing.assert_close(rendered.images["thermal"], rendered.alphas["thermal"] * decoded)
    assert model.formations.found("point_spread") == pytest.approx({"thermal": 0.05})
    largest = largest_gradients(model, rendered.images["thermal"].square().sum())
    assert largest["formations.by_spectrum.thermal.point_spread.log_width"] > 0.0
    both = toy_model(toy_config(decoder=decoder, spectra={"rgb": {"point_spread": 0.05}}), capture)
    difference = render(both, frame).images["rgb"] - sharp.images["rgb"]
    assert difference.abs().max() > 0.01


def test_maps_are_not_blurred() -> None:
    """No camera takes them, and they are rendered tile by tile."""
    capture = toy_capture()
    frame, spectra = toy_frame(capture), {"thermal": {"point_spread": 0.05}}
    above = {name: dataclasses.replace(view, orthographic=True) for name, view in frame.views.items()}
    frame = dataclasses.replace(frame, views=above)
    sharp, model = render(toy_model(toy_config(), capture), frame), toy_model(toy_config(spectra=spectra), capture)
    torch.testing.assert_close(render(model, frame).images, sharp.images)


@pytest.mark.parametrize("feature_dim", [16, 80])
def test_more_features_than_one_traversal_blends(feature_dim: int) -> None:
    """They are blended in several, and every one of them is rendered and trained."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(feature_dim=feature_dim), capture)
    rendered = render(model, frame)
    assert rendered.features["rgb"].shape == rendered.features["thermal"].shape == (18, 24, feature_dim)
    model.zero_grad()
    (rendered.images["rgb"].sum() + rendered.images["thermal"].sum()).backward()
    assert (model.gaussians("shared").features.grad.abs().amax(0) > 0).all()


def test_unaligned_frame_is_one_call_per_spectrum() -> None:
    """A thermal camera of its own keeps its size; densification sees one info for each call."""
    capture = toy_capture(aligned=False)
    rendered = render(toy_model(toy_config(), capture), toy_frame(capture))
    assert rendered.images["rgb"].shape == (18, 24, 3)
    assert rendered.images["thermal"].shape == (14, 16, 3)
    assert [info["width"] for info in rendered.infos["shared"]] == [24, 16]
    assert [info["spectra"] for info in rendered.infos["shared"]] == [("rgb",), ("thermal",)]


def test_rgb_alone_has_no_thermal_gradient() -> None:
    """Rendered alone, RGB moves the Gaussians as in the joint call, and never the thermal opacities."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    joint = render(model, frame)
    alone = render(model, frame, only=("rgb",))
    model.zero_grad()
    joint.images["rgb"].square().sum().backward()
    expected = {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}
    model.zero_grad()
    alone.images["rgb"].square().sum().backward()
    shared = model.gaussians("shared")
    for name in ("means", "log_scales", "logit_opacities", "features", "sh0"):
        torch.testing.assert_close(
            getattr(shared, name).grad, expected[f"gaussian_sets.shared.{name}"], atol=1e-4, rtol=1e-3
        )
    assert shared.thermal_opacity_offsets.grad is None or not shared.thermal_opacity_offsets.grad.any()


def test_hybrid_sum_starts_at_the_sh_colour() -> None:
    """With untrained decoders the RGB image is the SH render, brighter by about 0.018."""
    capture = toy_capture()
    config = dataclasses.replace(toy_config(), background=(0.2, 0.4, 0.6))
    model = SceneModel.from_capture(config, capture, "cpu")
    frame = toy_frame(capture)
    hybrid = render(model, frame).images["rgb"]
    model.formations.decoder.heads["rgb"].bias.data.fill_(-100.0)
    explicit = render(model, frame).images["rgb"]
    difference = (hybrid - explicit).detach()
    alpha = render(model, frame).alphas["rgb"]
    assert alpha.max() > 0.2
    assert (difference > 0.01 * alpha).all()
    assert (difference < 0.03 * alpha).logical_or(alpha < 1e-6).all()


def test_without_hybrid_rgb_is_the_decoded_part() -> None:
    """Ablation: the SH colours then have neither effect nor gradient."""
    capture = toy_capture()
    frame = toy_frame(capture)
    model = toy_model(toy_config(decoder={"hybrid": False}), capture)
    rendered = render(model, frame)
    decoded = model.formations.decoder.image("rgb", rendered.features["rgb"])
    torch.testing.assert_close(rendered.images["rgb"], rendered.alphas["rgb"] * decoded)
    largest = largest_gradients(model, rendered.images["rgb"].square().sum())
    assert largest["gaussian_sets.shared.sh0"] == 0.0
    assert largest["gaussian_sets.shared.features"] > 0.0


def test_hybrid_rgb_is_the_sum() -> None:
    """The full model: SH render plus decoded part, not clamped."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    with torch.no_grad():
        model.gaussians("shared").sh0 += 2.0
    rendered = render(model, frame)
    decoder = model.formations.decoder
    explicit = rendered.images["rgb"] - rendered.alphas["rgb"] * decoder.image("rgb", rendered.features["rgb"])
    decoder.heads["rgb"].bias.data.fill_(-100.0)
    torch.testing.assert_close(render(model, frame).images["rgb"], explicit, atol=1e-5, rtol=1e-5)
    assert rendered.images["rgb"].max() > 1.0


@pytest.mark.parametrize("branches", ["joined", "separate"])
@pytest.mark.parametrize("hybrid", [True, False])
def test_padding_widens_the_range_of_images_that_are_decoded_alone(hybrid: bool, branches: str) -> None:
    """By as much on both sides, before Gaussians cover them; the sum with SH colours has no range to widen."""
    capture = toy_capture()
    decoder = {"hybrid": hybrid, "branches": branches, "modulation": branches == "joined"}
    plain, padded = (toy_model(toy_config(decoder=decoder | {"padding": by}), capture) for by in (0.0, 0.25))
    before, after = (render(model, toy_frame(capture)) for model in (plain, padded))
    for name in ("rgb", "thermal"):
        decoded = before.alphas[name] * plain.formations.decoder.image(name, before.features[name])
        wider = 0.5 * decoded - 0.25 * before.alphas[name]
        expected = before.images[name] + (0.0 if hybrid and name == "rgb" else wider)
        torch.testing.assert_close(after.images[name], expected, msg=name)


@pytest.mark.parametrize("aligned", [True, False])
@pytest.mark.parametrize("hybrid", [True, False])
def test_background_shows_where_no_gaussian_is(hybrid: bool, aligned: bool) -> None:
    """Without Gaussians in view RGB is the background and thermal black."""
    capture = toy_capture(aligned=aligned)
    config = dataclasses.replace(toy_config(decoder={"hybrid": hybrid}), background=(0.2, 0.4, 0.6))
    model, frame = SceneModel.from_capture(config, capture, "cpu"), toy_frame(capture)
    with torch.no_grad():
        model.gaussians("shared").means += 1e4
    rendered = render(model, frame)
    torch.testing.assert_close(rendered.images["rgb"], model.background.expand_as(rendered.images["rgb"]))
    assert (rendered.images["thermal"] == 0).all()


def test_every_parameter_is_trained_by_the_full_model() -> None:
    """The two images together give a gradient to every parameter there is."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    torch.nn.init.normal_(
        model.formations.decoder.modulations["rgb"].weight, std=0.1
    )  # else the prior's gradient comes by thermal alone
    rendered = render(model, frame)
    largest = largest_gradients(
        model, rendered.images["rgb"].square().sum() + rendered.images["thermal"].square().sum()
    )
    assert [name for name, value in largest.items() if value == 0.0] == []


def test_thermal_image_does_not_train_visible_colours() -> None:
    """The thermal branch reaches geometry, features and offsets, but neither SH colours nor the RGB head."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(), capture)
    largest = largest_gradients(model, render(model, frame).images["thermal"].square().sum())
    untouched = {name for name, value in largest.items() if value == 0.0}
    assert untouched == {
        "gaussian_sets.shared.sh0",
        "gaussian_sets.shared.shN",
        "formations.decoder.modulations.rgb.weight",
        "formations.decoder.modulations.rgb.bias",
        "formations.decoder.heads.rgb.weight",
        "formations.decoder.heads.rgb.bias",
    }


def test_without_geometric_decoupling_both_opacities_are_one() -> None:
    """Ablation: features are blended once, for both spectra, and images are those of two calls."""
    capture = toy_capture()
    model, frame = toy_model(toy_config(spectra={"thermal": {"opacity": "shared"}}), capture), toy_frame(capture)
    rendered = render(model, frame, depth_spread_limit=0.0)
    assert rendered.features["thermal"] is rendered.features["rgb"]
    assert rendered.alphas["thermal"] is rendered.alphas["rgb"]
    assert len(rendered.depth_spreads) == 1
    apart = render(model, frame, shared_cameras=APART, depth_spread_limit=0.0)
    for kind in ("images", "features", "alphas"):
        torch.testing.assert_close(getattr(rendered, kind), getattr(apart, kind))
    torch.testing.assert_close(rendered.depth_spreads * 2, apart.depth_spreads)


def test_scalar_thermal_has_one_decoded_channel() -> None:
    """Radiometric captures are decoded to one channel."""
    capture = toy_capture(thermal_kind="scalar")
    rendered = render(toy_model(toy_config(), capture), toy_frame(capture))
    assert rendered.images["thermal"].shape == (18, 24, 1)


def test_densification_reads_gradients_of_means2d() -> None:
    """means2d of every call keeps its gradient, and absolute gradients where asked."""
    capture = toy_capture()
    rendered = render(toy_model(toy_config(), capture), toy_frame(capture), absgrad=True)
    means2d = rendered.infos["shared"][0]["means2d"]
    means2d.retain_grad()
    (rendered.images["rgb"].square().sum() + rendered.images["thermal"].square().sum()).backward()
    assert means2d.grad.shape == (1, 60, 2)
    assert means2d.grad.abs().max() > 0
    assert (means2d.absgrad >= means2d.grad.abs() - 1e-4).all()


@pytest.mark.parametrize(
    "model_config",
    [
        {},
        {"gaussian_sets": "separate", "feature_dim": 0},
        {"without": ("thermal",)},
        {"without": ("rgb",)},
        {"feature_dim": 0},
        {"feature_dim": 0, "spectra": {"thermal": {"opacity": "own"}}},
        {"decoder": {"fourier_frequency": 3.0}},
    ],
)
def test_checkpoint_restores_the_same_images(model_config: dict[str, Any]) -> None:
    """from_checkpoint of checkpoint_state renders the same, bit by bit, for every kind of model."""
    capture = toy_capture()
    config = dataclasses.replace(toy_config(**model_config), background=(0.1, 0.0, 0.3))
    frame, model = toy_frame(capture), toy_model(config, capture)
    checkpoint = Checkpoint(1, config, 1, model.checkpoint_state(), {}, SavedTraining())
    expected, restored = render(model, frame), render(SceneModel.from_checkpoint(checkpoint, "cpu"), frame)
    assert list(expected.images) == list(restored.images)
    assert all(torch.equal(image, restored.images[name]) for name, image in expected.images.items())


def test_seed_decides_the_start() -> None:
    """The same seed gives the same model whatever was drawn before, and leaves the global generator alone."""
    capture = toy_capture()
    first = SceneModel.from_capture(toy_config(), capture, "cpu").state_dict()
    torch.manual_seed(99)
    state = torch.get_rng_state()
    again = SceneModel.from_capture(toy_config(), capture, "cpu").state_dict()
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_missing_spectrum_is_a_users_error() -> None:
    """A spectrum that is to be modelled must have training images; one that is not need not. The flag is named."""
    rgb_only = toy_capture(thermal=False)
    with pytest.raises(UserError, match="--without thermal"):
        SceneModel.from_capture(toy_config(), rgb_only, "cpu")
    assert list(SceneModel.from_capture(toy_config(without=("thermal",)), rgb_only, "cpu").spectra) == ["rgb"]
    with pytest.raises(UserError, match="--without rgb"):
        SceneModel.from_capture(toy_config(), toy_capture(rgb=False), "cpu")


@pytest.mark.parametrize("aligned", [True, False])
def test_decoders_that_see_the_viewing_direction(aligned: bool) -> None:
    """Separate decoders with directions render both spectra; directions change the image."""
    capture = toy_capture(aligned=aligned)
    frame = toy_frame(capture)
    switches = {"branches": "separate", "modulation": False, "hybrid": False, "view_direction": True}
    model = toy_model(toy_config(decoder=switches), capture)
    rendered = render(model, frame)
    assert rendered.images["rgb"].shape == (18, 24, 3)
    assert rendered.images["thermal"].shape == (frame.views["thermal"].height, frame.views["thermal"].width, 3)
    with torch.no_grad():
        model.formations.decoder.networks["rgb"][0].weight[:, 8:] = 0.0
    assert not torch.allclose(render(model, frame).images["rgb"], rendered.images["rgb"], atol=1e-4)


def test_decoders_that_see_waves_of_the_features() -> None:
    """Waves change the images of both spectra."""
    capture = toy_capture()
    frame, model = toy_frame(capture), toy_model(toy_config(decoder={"fourier_frequency": 3.0}), capture)
    rendered = render(model, frame).images
    with torch.no_grad():
        model.formations.decoder.shared_encoder[0].weight[:, 8:] = 0.0
    assert not any(
        torch.allclose(image, rendered[name], atol=1e-4) for name, image in render(model, frame).images.items()
    )


THREE = {
    "one opacity": ({"opacity": "shared"}, ["rasterization_rgbt"]),
    "its own offset": ({"opacity": "offset"}, ["rasterization_rgbt", "rasterization"]),
    "its own logits": ({"opacity": "own"}, ["rasterization_rgbt", "rasterization"]),
}


@pytest.mark.parametrize(("nir", "calls"), THREE.values(), ids=THREE)
def test_a_third_spectrum(nir: dict[str, Any], calls: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """It costs a traversal only where it has an opacity of its own; every parameter is trained by the three images."""
    capture = toy_capture(others=("nir",))
    model, frame = toy_model(toy_config(spectra={"nir": nir}), capture), toy_frame(capture)
    made = count_calls(monkeypatch)
    rendered = render(model, frame)
    assert made == calls
    assert {name: image.shape[-1] for name, image in rendered.images.items()} == {"rgb": 3, "thermal": 3, "nir": 1}
    apart = render(model, frame, shared_cameras=[[name] for name in frame.views])
    for name, image in rendered.images.items():
        torch.testing.assert_close(image, apart.images[name], atol=2e-6, rtol=1e-5)
    torch.nn.init.normal_(model.formations.decoder.modulations["rgb"].weight, std=0.1)
    rendered = render(model, frame)
    largest = largest_gradients(model, sum(image.square().sum() for image in rendered.images.values()))
    assert [name for name, value in largest.items() if value == 0.0] == []


def test_a_third_spectrum_with_a_camera_of_its_own() -> None:
    """Thermal with another camera, NIR with the photograph's: one traversal for two, one for thermal."""
    capture = toy_capture(aligned=False, others=("nir",))
    rendered = render(toy_model(toy_config(spectra={"nir": {}}), capture), toy_frame(capture))
    assert rendered.images["nir"].shape == (18, 24, 1)
    assert rendered.images["thermal"].shape == (14, 16, 3)
    assert [info["spectra"] for info in rendered.infos["shared"]] == [("rgb", "nir"), ("thermal",)]


def test_bands_beside_photographs_without_thermal() -> None:
    """Red edge and near infrared beside RGB: the first of them modulates the photograph in place of thermal."""
    capture = toy_capture(thermal=False, others=("red_edge", "nir"))
    config = toy_config(spectra={"red_edge": {}, "nir": {"opacity": "offset"}}, without=("thermal",))
    model = toy_model(config, capture)
    assert model.formations.decoder.modulated_by["rgb"] == "red_edge"
    assert set(model.formations.decoder.priors) == {"red_edge", "nir"}
    rendered = render(model, toy_frame(capture))
    assert list(model.spectra) == ["rgb", "red_edge", "nir"]
    assert rendered.images.keys() == model.spectra.keys()
    assert "nir_opacity_offsets" in dict(model.gaussians("shared").named_parameters())


def test_scalars_alone() -> None:
    """Without photographs nothing has SH colours: all images are decoded."""
    capture = toy_capture(rgb=False, others=("nir",))
    model = toy_model(toy_config(spectra={"nir": {"opacity": "offset"}}, without=("rgb",)), capture)
    assert not any(model.formations[name].takes_colors for name in model.spectra)
    rendered = render(model, toy_frame(capture))
    assert all(image.min() >= 0 and image.max() <= 1 for image in rendered.images.values())
    assert [info["spectra"] for info in rendered.infos["shared"]] == [("thermal",), ("nir",)]


@pytest.mark.parametrize("feature_dim", [8, 0])
def test_spectra_that_do_not_shape_the_scene(feature_dim: int) -> None:
    """Their images are the same; their colours learn, geometry does not, and density control sees no call of theirs."""
    capture = toy_capture(aligned=False)
    frame, model = toy_frame(capture), toy_model(toy_config(feature_dim=feature_dim), capture)
    free, held = (render(model, frame, shared_cameras=APART, shaped_by=by) for by in (None, ("rgb",)))
    assert [info["spectra"] for info in held.infos["shared"]] == [("rgb",)]
    for name, image in free.images.items():
        assert torch.equal(held.images[name], image)
    geometry = ("means", "quats", "log_scales", "logit_opacities", "thermal_opacity_offsets")
    reached = largest_gradients(model, free.images["thermal"].square().sum())
    assert all(reached[f"gaussian_sets.shared.{name}"] > 0 for name in geometry)
    held = render(model, frame, shared_cameras=APART, shaped_by=("rgb",))
    reached = largest_gradients(model, held.images["thermal"].square().sum())
    assert not any(reached[f"gaussian_sets.shared.{name}"] for name in geometry)
    colors = "features" if feature_dim else "thermal_sh0"
    assert reached[f"gaussian_sets.shared.{colors}"] > 0
    reached = largest_gradients(model, held.images["rgb"].square().sum())
    assert reached["gaussian_sets.shared.means"] > 0


@pytest.mark.parametrize("restored", [False, True])
@pytest.mark.parametrize("trained", ["lens", "readout", None])
def test_pinholes_see_a_scene_as_it_was_trained(trained: str | None, restored: bool) -> None:
    """What is trained through a lens or a shutter is seen as through a lens that bends nothing; nothing else is."""
    capture = toy_capture(aligned=False)
    frame, flat = toy_frame(capture), torch.zeros(8)
    barrel = LensCoefficients("pinhole", (-0.2, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0))
    taken = {None: capture, "lens": through(capture, {"rgb": barrel}), "readout": shaken(capture, ("thermal",))}[
        trained
    ]
    config = toy_config()
    model = toy_model(config, taken)
    if restored:
        saved = Checkpoint(1, config, 1, model.checkpoint_state(), {}, SavedTraining())
        model = SceneModel.from_checkpoint(saved, "cpu")
    seen = []
    for lens in (None, flat):
        views = {name: dataclasses.replace(view, lens=lens) for name, view in frame.views.items()}
        images = model.render(views, sh_degree=1).images.values()
        seen.append([*images, model.render_depth("thermal", views["thermal"])])
    differences = [float((one - other).detach().abs().max()) for one, other in zip(*seen, strict=True)]
    assert max(differences) < 1e-5 if trained is not None else min(differences) > 1e-3
