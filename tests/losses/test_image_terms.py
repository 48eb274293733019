"""The training loss, term by term, against direct formulas."""

import dataclasses

import numpy as np
import pytest
import torch
from kornia.losses import ssim_loss

from direct_ssim import direct_ssim
from thermosplat.config import LossConfig, TrainConfig
from thermosplat.datasets.frame_tensors import FrameTensors
from thermosplat.losses.image_terms import compare_frame, image_loss, smoothness
from thermosplat.scene.rendered_frame import RenderedFrame
from toy_scene import toy_capture, toy_config, toy_frame, toy_model, with_spectra


def images(channels: int = 3, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(18, 24, channels, generator=generator)
    return (target + 0.2 * torch.randn(target.shape, generator=generator)), target


def frame_losses(rendered: RenderedFrame, frame: FrameTensors, config: TrainConfig) -> dict[str, torch.Tensor]:
    return compare_frame(rendered, frame, config).losses


def rendered_and_frame(**capture):
    toy = toy_capture(**capture)
    frame = toy_frame(toy)
    return toy_model(toy_config(), toy).render(frame.views, sh_degree=1), frame


def direct_image_loss(render: torch.Tensor, target: torch.Tensor) -> float:
    a, b = render.detach().double().numpy(), target.double().numpy()
    return 0.8 * np.abs(a - b).mean() + 0.2 * (1 - direct_ssim(a, b))


def test_image_loss_against_the_definition() -> None:
    """0.8 L1 + 0.2 (1 - SSIM), on a render that leaves [0, 1]."""
    render, target = images()
    assert render.max() > 1.2
    np.testing.assert_allclose(image_loss(render, target, 0.2).item(), direct_image_loss(render, target), rtol=1e-5)


def test_ssim_term_is_not_halved() -> None:
    """With λ_s = 1 the loss is 1 - SSIM, twice kornia's own SSIM loss."""
    render, target = images()
    halved = ssim_loss(render.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None], 11)
    torch.testing.assert_close(image_loss(render, target, 1.0), 2 * halved)


def test_l1_alone() -> None:
    """λ_s = 0 leaves the mean absolute error."""
    render, target = images()
    torch.testing.assert_close(image_loss(render, target, 0.0), (render - target).abs().mean())


def test_saturated_pixels_keep_their_gradient() -> None:
    """The loss is on the raw render: too bright is pulled back."""
    render = torch.full((12, 12, 3), 1.5, requires_grad=True)
    image_loss(render, torch.ones(12, 12, 3), 0.2).backward()
    assert (render.grad > 0).all()


@pytest.mark.parametrize("capture", [{}, {"thermal_kind": "scalar"}, {"aligned": False}])
def test_all_terms_against_the_definitions(capture: dict) -> None:
    """The batched SSIM gives every term its own value, whatever sizes and channels the images have."""
    rendered, frame = rendered_and_frame(**capture)
    losses = {name: value.item() for name, value in frame_losses(rendered, frame, TrainConfig()).items()}
    thermal = rendered.images["thermal"].detach().double().numpy()
    variation = np.abs(np.diff(thermal, axis=0)).sum() + np.abs(np.diff(thermal, axis=1)).sum()
    expected = {
        "rgb": direct_image_loss(rendered.images["rgb"], frame.views["rgb"].image),
        "thermal": direct_image_loss(rendered.images["thermal"], frame.views["thermal"].image),
        "features_rgb": direct_image_loss(rendered.features["rgb"][..., :3], frame.views["rgb"].image),
        "features_thermal": 0.5
        * direct_image_loss(rendered.features["thermal"][..., 3:4], frame.views["thermal"].intensity[..., None]),
        "thermal_smoothness": 0.3 * variation / thermal.size,
    }
    assert list(losses) == list(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(losses[name], value, rtol=2e-5, err_msg=name)


def test_weights_scale_their_terms() -> None:
    """Each weight multiplies its own term; features multiplies both feature terms."""
    rendered, frame = rendered_and_frame()
    ones = with_spectra(TrainConfig(), thermal={"features": 1.0, "smoothness": 1.0})
    weights = with_spectra(
        TrainConfig(loss=LossConfig(features=5)),
        rgb={"loss": 2.0, "features": 7.0},
        thermal={"loss": 3.0, "features": 11.0, "smoothness": 13.0},
    )
    base, weighted = frame_losses(rendered, frame, ones), frame_losses(rendered, frame, weights)
    factors = {"rgb": 2, "thermal": 3, "features_rgb": 35, "features_thermal": 55, "thermal_smoothness": 13}
    for name, factor in factors.items():
        torch.testing.assert_close(weighted[name], factor * base[name])


@pytest.mark.parametrize(
    ("config", "gone"),
    [
        (with_spectra(TrainConfig(), rgb={"loss": 0.0}), {"rgb"}),
        (with_spectra(TrainConfig(), thermal={"loss": 0.0}), {"thermal"}),
        (TrainConfig(loss=LossConfig(features=0.0)), {"features_rgb", "features_thermal"}),
        (with_spectra(TrainConfig(), rgb={"features": 0.0}), {"features_rgb"}),
        (with_spectra(TrainConfig(), thermal={"features": 0.0}), {"features_thermal"}),
        (with_spectra(TrainConfig(), thermal={"features": None}), {"features_thermal"}),
        (with_spectra(TrainConfig(), thermal={"smoothness": 0.0}), {"thermal_smoothness"}),
    ],
)
def test_zero_weight_drops_the_term(config: TrainConfig, gone: set[str]) -> None:
    """The ablations: a term with weight 0 is not listed, the others keep their values."""
    rendered, frame = rendered_and_frame()
    full = frame_losses(rendered, frame, TrainConfig())
    reduced = frame_losses(rendered, frame, config)
    assert set(full) - set(reduced) == gone
    for name, value in reduced.items():
        torch.testing.assert_close(value, full[name])


def test_one_spectrum_alone() -> None:
    """Without a thermal image only the RGB terms are there, and the other way round."""
    toy = toy_capture()
    frame, model = toy_frame(toy), toy_model(toy_config(), toy)
    rgb = model.render({"rgb": frame.views["rgb"]}, sh_degree=1)
    assert list(frame_losses(rgb, frame, TrainConfig())) == ["rgb", "features_rgb"]
    thermal = model.render({"thermal": frame.views["thermal"]}, sh_degree=1)
    assert list(frame_losses(thermal, frame, TrainConfig())) == ["thermal", "features_thermal", "thermal_smoothness"]


def masked_frame(frame: FrameTensors) -> tuple[FrameTensors, torch.Tensor]:
    """The frame with the same mask in all views, and the mask."""
    mask = torch.ones(frame.views["rgb"].image.shape[:2], dtype=torch.bool)
    mask[: len(mask) // 2, 3:] = False
    views = {name: dataclasses.replace(view, mask=mask) for name, view in frame.views.items()}
    return dataclasses.replace(frame, views=views), mask


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("capture", [{}, {"thermal_kind": "scalar"}])
def test_masked_pixels_are_not_seen(capture: dict, fused: bool) -> None:
    """Whatever image and truth are there: losses, errors and gradients are those of the other pixels."""
    rendered, frame = rendered_and_frame(**capture)
    frame, mask = masked_frame(frame)
    found = []
    for truth in (0.0, 0.7):
        images = {
            name: torch.where(mask[..., None], image, 0.3).detach().requires_grad_()
            for name, image in rendered.images.items()
        }
        features = {
            name: torch.where(mask[..., None], image, 0.6).detach().requires_grad_()
            for name, image in rendered.features.items()
        }
        views = {
            name: dataclasses.replace(
                view,
                image=torch.where(mask[..., None], view.image, truth),
                intensity=None if view.intensity is None else torch.where(mask, view.intensity, truth),
            )
            for name, view in frame.views.items()
        }
        seen = dataclasses.replace(rendered, images=images, features=features)
        compared = compare_frame(seen, dataclasses.replace(frame, views=views), TrainConfig(), fused=fused)
        sum(loss for name, loss in compared.losses.items() if name != "thermal_smoothness").backward()
        gradients = [image.grad for image in (*images.values(), *features.values())]
        for gradient in gradients:
            assert gradient[~mask].abs().max() == 0
            assert gradient[mask].abs().max() > 0
        found.append((list(compared.losses.values()), list(compared.squared_errors.values()), gradients))
        for name, error in compared.squared_errors.items():
            counting = (images[name].detach().clamp(0, 1) - views[name].image)[mask]
            torch.testing.assert_close(error, counting.square().mean())
    for one, other in zip(*found):
        torch.testing.assert_close(one, other)


def test_a_mask_that_is_white_changes_nothing() -> None:
    """Term by term."""
    rendered, frame = rendered_and_frame()
    white = {
        name: dataclasses.replace(view, mask=torch.ones(view.image.shape[:2], dtype=torch.bool))
        for name, view in frame.views.items()
    }
    plain = compare_frame(rendered, frame, TrainConfig())
    compared = compare_frame(rendered, dataclasses.replace(frame, views=white), TrainConfig())
    torch.testing.assert_close(compared.losses, plain.losses)
    torch.testing.assert_close(compared.squared_errors, plain.squared_errors)


def test_total_trains_every_gaussian_parameter() -> None:
    """The sum of all terms reaches every parameter of the Gaussians."""
    toy = toy_capture()
    frame, model = toy_frame(toy), toy_model(toy_config(), toy)
    rendered = model.render(frame.views, sh_degree=1)
    sum(frame_losses(rendered, frame, TrainConfig()).values()).backward()
    assert all(p.grad.abs().max() > 0 for p in model.gaussians("shared").parameters())


def test_smoothness_of_a_ramp() -> None:
    """Forward differences, no wrap-around, normalised by all pixels and channels."""
    ramp = (torch.arange(4.0)[:, None] + 10 * torch.arange(5.0)[None])[..., None].expand(-1, -1, 2)
    expected = (3 * 5 * 1.0 + 4 * 4 * 10.0) / 20
    torch.testing.assert_close(smoothness(ramp), torch.tensor(expected))
    assert smoothness(torch.full((4, 5, 3), 0.7)) == 0


def test_squares_are_added_to_the_images_term_alone() -> None:
    """k d² beside |d|, in a spectrum's image loss and in no other term."""
    rendered, frame = rendered_and_frame()
    plain = frame_losses(rendered, frame, TrainConfig())
    squared = frame_losses(rendered, frame, with_spectra(TrainConfig(), thermal={"squared": 30.0, "loss": 2.0}))
    for name in set(plain) - {"thermal"}:
        torch.testing.assert_close(squared[name], plain[name])
    difference = rendered.images["thermal"] - frame.views["thermal"].image
    added = 0.8 * 30 * difference.square().mean()
    torch.testing.assert_close(squared["thermal"], 2 * (plain["thermal"] + added))


def as_leaves(rendered: RenderedFrame, device: torch.device) -> tuple[RenderedFrame, list[torch.Tensor]]:
    """The images of a render in float64 as leaves."""
    leaves: list[torch.Tensor] = []

    def leaf(image: torch.Tensor) -> torch.Tensor:
        leaves.append(image.detach().double().to(device).requires_grad_())
        return leaves[-1]

    images = {name: leaf(image) for name, image in rendered.images.items()}
    features = {name: leaf(image) for name, image in rendered.features.items()}
    return RenderedFrame(images=images, features=features), leaves


@pytest.mark.parametrize("capture", [{}, {"thermal_kind": "scalar"}, {"aligned": False}])
@pytest.mark.parametrize(
    "config",
    [
        TrainConfig(),
        with_spectra(TrainConfig(), rgb={"squared": 15.0}, thermal={"squared": 30.0}),
        with_spectra(TrainConfig(), thermal={"loss": 0.0}),
        with_spectra(TrainConfig(loss=LossConfig(features=0.0)), rgb={"loss": 0.0}),
        with_spectra(TrainConfig(), thermal={"smoothness": 0.0}),
        with_spectra(TrainConfig(), rgb={"smoothness": 0.2}),
    ],
)
def test_fused_terms_are_the_filtered_ones(device: torch.device, capture: dict, config: TrainConfig) -> None:
    """All terms by one call of Warp's kernels: values, gradients and squared errors are those of kornia and torch."""
    rendered, frame = rendered_and_frame(**capture)
    views = {
        name: dataclasses.replace(
            view,
            image=view.image.double().to(device),
            intensity=None if view.intensity is None else view.intensity.double().to(device),
        )
        for name, view in frame.views.items()
    }
    frame = dataclasses.replace(frame, views=views)
    results = []
    for fused in (True, False):
        images, leaves = as_leaves(rendered, device)
        images.images["thermal"].data[2:5, 3:6] = 0.25  # where there is no slope, smoothness has no gradient
        images.images["rgb"].data[0] = 1.5  # squared errors are those of clamped images
        compared = compare_frame(images, frame, config, fused=fused)
        total = sum(weight * loss for weight, loss in enumerate(compared.losses.values(), 1))
        slopes = torch.autograd.grad(total, leaves, allow_unused=True)
        results.append((compared, [torch.zeros(()) if slope is None else slope for slope in slopes]))
    (ours, our_slopes), (theirs, their_slopes) = results
    assert list(ours.losses) == list(theirs.losses)
    for found, expected in ((ours.losses, theirs.losses), (ours.squared_errors, theirs.squared_errors)):
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            torch.testing.assert_close(found[name], value, rtol=1e-11, atol=1e-14, msg=name)
    for found, expected in zip(our_slopes, their_slopes, strict=True):
        torch.testing.assert_close(found.expand_as(expected), expected, rtol=1e-8, atol=1e-13, check_device=False)


def test_terms_of_three_spectra() -> None:
    """Each spectrum has its image term, its latent channel and its smoothness; each term knows its spectrum."""
    toy = toy_capture(others=("nir",))
    config = toy_config(spectra={"nir": {"loss": 2.0, "smoothness": 0.1}})
    frame, model = toy_frame(toy), toy_model(config, toy)
    rendered = model.render(frame.views, sh_degree=1)
    compared = compare_frame(rendered, frame, config)
    assert list(compared.losses) == [
        *("rgb", "thermal", "nir", "features_rgb", "features_thermal", "features_nir"),
        *("thermal_smoothness", "nir_smoothness"),
    ]
    assert compared.spectra["features_nir"] == compared.spectra["nir_smoothness"] == "nir"
    nir = frame.views["nir"]
    np.testing.assert_allclose(
        compared.losses["nir"].item(), 2 * direct_image_loss(rendered.images["nir"], nir.image), rtol=2e-5
    )
    np.testing.assert_allclose(
        compared.losses["features_nir"].item(),
        0.5 * direct_image_loss(rendered.features["nir"][..., 4:5], nir.intensity[..., None]),
        rtol=2e-5,
    )
    assert list(compared.squared_errors) == ["rgb", "thermal", "nir"]
