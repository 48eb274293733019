"""The noise of training images is measured, stripes included; smoothness, the weight of a loss and blur follow it."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from thermosplat.config.run_schedule import in_steps
from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError
from thermosplat.evaluation.loaded_run import load_run
from thermosplat.spectra import SpectrumConfig
from thermosplat.thermal.radiometry import FLIR_IRON, PixelScale
from thermosplat.thermography.display_range import times_as_wide
from thermosplat.training.frames.train_frames import TrainFrames
from thermosplat.training.image_noise import (
    ImageNoise,
    image_noise,
    training_noise,
)
from thermosplat.training.sensor_facts import SensorFacts, by_noise
from thermosplat.training.step_kind import StepKind
from thermosplat.training.trainer import Trainer
from toy_run import many_frames, step_gradients, toy_run_config, toy_trainer, without
from toy_scene import toy_capture

HEIGHT, WIDTH = 240, 320
MEASURED = {"smoothness": 0.3, "by_noise": True}


def scene() -> torch.Tensor:
    """A smooth scene with warm things of sharp edges, [H, W, 3]."""
    y, x = torch.meshgrid(torch.linspace(0, 1, HEIGHT), torch.linspace(0, 1, WIDTH), indexing="ij")
    image = 0.4 + 0.2 * torch.sin(5 * x) * y
    image[40:90, 100:180] += 0.2
    image[150:200, 30:60] -= 0.15
    return image[..., None].repeat(1, 1, 3)


@pytest.mark.parametrize("sigma", [0.002, 0.0134, 0.05])
def test_noise_of_pixels(sigma: float) -> None:
    """What was added is found, and taken for pixels' noise."""
    torch.manual_seed(0)
    noise = image_noise(scene() + sigma * torch.randn(HEIGHT, WIDTH, 3))
    assert noise.pixels == pytest.approx(sigma, rel=0.15)
    assert noise.stripes < 0.2 * sigma


def test_noise_of_what_counts() -> None:
    """A sky that was painted black has no noise, and hides none."""
    torch.manual_seed(0)
    image, mask = scene() + 0.02 * torch.randn(HEIGHT, WIDTH, 3), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[: 2 * HEIGHT // 3] = False
    image[~mask] = 0
    assert image_noise(image, mask).plain == pytest.approx(0.02, rel=0.1)
    assert image_noise(image).plain < 0.002
    assert image_noise(image, torch.zeros_like(mask)) == image_noise(image)


@pytest.mark.parametrize("along", [0, 1])
def test_noise_of_stripes(along: int) -> None:
    """What is constant along columns, or rows, is found as stripes, beside the pixels' own noise."""
    torch.manual_seed(0)
    shape = (1, WIDTH, 1) if along == 0 else (HEIGHT, 1, 1)
    noise = image_noise(scene() + 0.01 * torch.randn(shape) + 0.005 * torch.randn(HEIGHT, WIDTH, 3))
    assert noise.stripes == pytest.approx(0.01, rel=0.2)
    assert noise.pixels == pytest.approx(0.005, rel=0.15)
    assert noise.total == pytest.approx((noise.stripes**2 + noise.pixels**2) ** 0.5)


def test_texture_counts_for_little_where_the_scene_is_plain() -> None:
    """A sixth of the image is a fine pattern, which the mean of the responses takes for noise."""
    torch.manual_seed(0)
    image = scene() + 0.03 * torch.randn(HEIGHT, WIDTH, 3)
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH // 6), indexing="ij")
    image[:, : WIDTH // 6] += 0.4 * ((x // 2 + y // 2) % 2)[..., None]
    noise = image_noise(image)
    assert noise.pixels > 1.5 * 0.03
    assert noise.plain < 1.3 * 0.03
    assert image_noise(scene() + 0.03 * torch.randn(HEIGHT, WIDTH, 3)).plain == pytest.approx(0.03, rel=0.05)


def test_a_clean_image_has_none() -> None:
    """Edges of a scene count for next to nothing."""
    assert image_noise(scene()).total < 1.5e-3


def test_smoothness_rises_with_noise_between_bounds() -> None:
    """In proportion, never above the full weight, and never below the least one."""
    measured = SpectrumConfig(smoothness=0.3)
    weights = [by_noise(measured, noise)[0].smoothness for noise in (0.0, 0.001, 0.00625, 0.0125, 0.1)]
    assert weights == pytest.approx([0.05, 0.05, 0.15, 0.3, 0.3])
    assert by_noise(dataclasses.replace(measured, smoothness=0.01), 0.1)[0].smoothness == 0.01


def test_images_of_much_noise_count_once() -> None:
    """In proportion, and never less than once; a weight below 1 is nobody's to raise."""
    spectrum = SpectrumConfig(loss=2.0)
    weights = [by_noise(spectrum, noise)[0].loss for noise in (0.0, 0.0025, 0.0125, 0.1)]
    assert weights == pytest.approx([2, 1.8, 1, 1])
    assert by_noise(dataclasses.replace(spectrum, loss=0.5), 0.01) == (dataclasses.replace(spectrum, loss=0.5), [])


@pytest.mark.parametrize(("hottest", "corner", "weight"), [(30.0, 30.0, 0.3), (30.0, 300.0, 0.3), (300.0, 300.0, 0.05)])
def test_noise_is_large_or_small_beside_what_most_values_span(hottest: float, corner: float, weight: float) -> None:
    """0.4 K are much in 20 K, though one corner of 300 °C widens the range, and nothing where most values span 290."""
    capture = toy_capture(thermal_kind="scalar")
    values = np.random.default_rng(0).uniform(10.0, hottest, (180, 240)).astype(np.float32)
    values[0, 0] = corner
    view = dataclasses.replace(capture.train[0].views["thermal"], values=values)
    scale = PixelScale("scalar", FLIR_IRON, (10.0, corner), "celsius")
    frame = Frame("a", {**capture.train[0].views, "thermal": view})
    capture = dataclasses.replace(capture, train=(frame,), scales={**capture.scales, "thermal": scale})
    share = 0.4 / (corner - 10.0)
    noise = {"thermal": ImageNoise(share, 0.0, share)}.get
    config = toy_run_config(spectra={"thermal": MEASURED})
    fitted, _ = SensorFacts(config, noise, widths=partial(times_as_wide, capture)).fitted(config)
    assert fitted.spectra["thermal"].smoothness == pytest.approx(weight)


def noisy(capture: Capture, **sigmas: float) -> Capture:
    """The capture with grey images of some spectra and the noise of a bad sensor, in 8-bit steps."""

    def spoilt(frame: Frame) -> Frame:
        views = dict(frame.views)
        for name, sigma in sigmas.items():
            image = np.random.default_rng(0).normal(128, sigma, views[name].image.shape).clip(0, 255).astype(np.uint8)
            views[name] = dataclasses.replace(views[name], image=image)
        return dataclasses.replace(frame, views=views)

    return dataclasses.replace(capture, train=tuple(spoilt(frame) for frame in capture.train))


def test_a_run_takes_what_its_images_ask_for(tmp_path: Path) -> None:
    """It trains with the measured weight and says so; without the setting with the configured one."""
    config = toy_run_config(spectra={"thermal": MEASURED})
    trainer = toy_trainer(tmp_path / "a", config, noisy(many_frames(toy_capture()), thermal=8))
    assert trainer.device_step.config.spectra["thermal"].smoothness == 0.3
    (note,) = trainer.recipe.notes
    assert note.startswith("Noise of the thermal images 0.03")
    assert note.endswith("smoothness weight 0.300.")
    assert trainer.config == in_steps(config)
    rgb_alone = toy_run_config(spectra={"thermal": MEASURED}, without=("thermal",))
    assert toy_trainer(tmp_path / "b", rgb_alone, many_frames(toy_capture(thermal=False))).recipe.notes == ()
    plain = toy_trainer(tmp_path / "c", toy_run_config(), many_frames(toy_capture()))
    assert plain.recipe.notes == ()
    assert plain.device_step.config.spectra["thermal"].smoothness == 0.3


def test_a_run_weighs_what_its_images_ask_for(tmp_path: Path) -> None:
    """Its loss counts as often as its noise allows, and the user is told; the terms of the step say so."""
    config = toy_run_config(spectra={"thermal": {"loss": 2.0, "by_noise": True, "smoothness": 0.0}})
    capture = noisy(many_frames(toy_capture()), thermal=1)
    trainer = toy_trainer(tmp_path / "a", config, capture)
    noise = training_noise(trainer.frames, "thermal")
    assert noise is not None
    weight = trainer.device_step.config.spectra["thermal"].loss
    assert weight == pytest.approx(2 - noise.total / 0.0125)
    assert 1.2 < weight < 1.9
    trainer.save()
    assert load_run(trainer.run.path, device="cpu").config.spectra["thermal"].loss == 2.0  # as it was asked for
    (note,) = trainer.recipe.notes
    assert note.endswith(f"): loss weight {weight:.3f}.")
    once = toy_trainer(tmp_path / "b", toy_run_config(spectra={"thermal": {"smoothness": 0.0}}), capture)
    assert once.recipe.notes == ()
    kind = StepKind(0, densifying=False)
    terms, of_once = (step_gradients(run, kind).losses["thermal"] for run in (trainer, once))
    assert terms.item() == pytest.approx(weight * of_once.item(), rel=1e-5)


def test_both_weights_are_said_in_one_line(tmp_path: Path) -> None:
    """Noise is measured once for both."""
    config = toy_run_config(spectra={"thermal": {**MEASURED, "loss": 2.0}})
    (note,) = toy_trainer(tmp_path, config, noisy(many_frames(toy_capture()), thermal=8)).recipe.notes
    assert note.endswith("loss weight 1.000, smoothness weight 0.300.")


def test_no_blur_is_learnt_of_noise(tmp_path: Path) -> None:
    """Where images are noisy the model has no point spread, and says so; its checkpoint is read back without one."""
    config = toy_run_config(spectra={"thermal": {"smoothness": 0.0, "point_spread": 0.05, "by_noise": True}})
    runs = {sigma: noisy(many_frames(toy_capture()), thermal=sigma) for sigma in (1, 8)}
    clean = toy_trainer(tmp_path / "clean", config, runs[1])
    assert clean.model.formations.found("point_spread") == pytest.approx({"thermal": 0.05})
    assert clean.recipe.notes == ()

    trainer = toy_trainer(tmp_path / "noisy", config, runs[8])
    assert trainer.model.formations.found("point_spread") == {}
    (note,) = trainer.recipe.notes
    assert note.endswith("): no point spread.")
    trainer.train()
    resumed = Trainer.resume(dataclasses.replace(config, max_steps=14), runs[8], trainer.run)
    resumed.train()
    assert resumed.model.formations.found("point_spread") == {}
    loaded = load_run(trainer.run.path, device="cpu")
    assert (loaded.step, loaded.model.formations.found("point_spread")) == (14, {})
    assert loaded.config.spectra["thermal"].point_spread == 0.05  # as it was asked for


@pytest.mark.parametrize(("sigma", "most"), [(1, 300_000), (16, 150_000)])
def test_noisy_images_get_fewer_gaussians(tmp_path: Path, sigma: float, most: int) -> None:
    """The limit that a run takes from its images, and what it tells the user."""
    without_limit = dataclasses.replace(toy_run_config().densification, strategy="mcmc", max_gaussians=None)
    config = toy_run_config(budget="auto", densification=without_limit)
    trainer = toy_trainer(tmp_path, config, noisy(many_frames(toy_capture()), rgb=1, thermal=sigma))
    assert trainer.config.densification.max_gaussians == most
    said = "At most 150,000 Gaussians are made, since thermal images are noisy."
    assert (said in trainer.recipe.notes) == (most == 150_000)


@pytest.mark.parametrize(("budget", "counts"), [("auto", ("rgb",)), ("fixed", ())])
def test_which_images_count_as_noisy(budget: Literal["auto", "fixed"], counts: tuple[str, ...]) -> None:
    """From 0.033 on, with a budget; measured where the scene is plain, since texture is no noise."""

    def noise_of(name: str) -> ImageNoise | None:
        return {"rgb": ImageNoise(0.0, 0.0, 0.033), "thermal": ImageNoise(1.0, 1.0, 0.0329)}.get(name)

    config = toy_run_config(spectra={"nir": {}}, budget=budget)
    assert SensorFacts(config, noise_of).noisy == counts


def test_noisy_images_get_more_steps(tmp_path: Path) -> None:
    """A run that was interrupted after its usual number of steps goes on to those that noise asks for."""
    config = toy_run_config(6, budget="auto", noisy_steps=1.5)
    capture = noisy(many_frames(toy_capture()), rgb=16, thermal=1)
    trainer = toy_trainer(tmp_path / "noisy", config, capture)
    assert trainer.recipe.notes[0].startswith("Noisy RGB images: 9 steps of one frame in place of 6 (")
    while trainer.step < 7:
        trainer.train_step()
    trainer.save()
    resumed = Trainer.resume(config, noisy(capture, rgb=1), trainer.run)  # smaller ones have less noise
    assert resumed.train()["steps"] == 9
    with pytest.raises(UserError, match="has done 9 steps, the command asks for 8 in all"):
        Trainer.resume(dataclasses.replace(config, max_steps=8, noisy_steps=1.0), capture, trainer.run)
    for changes in ({"budget": "fixed"}, {"noisy_steps": 1.0}):
        other = dataclasses.replace(config, **changes)  # type: ignore[arg-type]
        assert toy_trainer(tmp_path / next(iter(changes)), other, capture).config.max_steps == 6
    assert toy_trainer(tmp_path / "clean", config, noisy(capture, rgb=1)).config.max_steps == 6


@pytest.mark.parametrize(("then", "now"), [(1, 8), (8, 1)])
def test_noise_of_other_images_changes_no_model(tmp_path: Path, then: int, now: int) -> None:
    """A run that goes on with smaller, less noisy images keeps its blur, or has none, in the next scene, too."""
    config = toy_run_config(spectra={"thermal": {"smoothness": 0.0, "point_spread": 0.05, "by_noise": True}}, scenes=2)
    config = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, cooldown_from=0.5))
    trainer = toy_trainer(tmp_path, config, noisy(many_frames(toy_capture()), thermal=then))
    trainer.train_step()
    trainer.save()
    resumed = Trainer.resume(config, noisy(many_frames(toy_capture()), thermal=now), trainer.run)
    resumed.train()
    blurred = [list(one.model.formations.found("point_spread")) for one in (resumed, trainer)]
    assert blurred == 2 * [[] if then == 8 else ["thermal"]]
    assert load_run(trainer.run.path, device="cpu").step == config.max_steps


def test_every_spectrum_is_measured_by_itself(tmp_path: Path) -> None:
    """Each has its own noise, its own setting and its own weight; one without the setting keeps what it has."""
    capture = noisy(many_frames(toy_capture(others=("nir", "red"))), rgb=2, thermal=8, nir=1)
    measured = {"rgb": MEASURED, "thermal": {}, "nir": MEASURED, "red": {"by_noise": True}}
    trainer = toy_trainer(tmp_path, toy_run_config(spectra=measured), capture)
    weights = {name: spectrum.smoothness for name, spectrum in trainer.device_step.config.spectra.items()}
    found = {name: training_noise(trainer.frames, name) for name in ("rgb", "nir")}
    for name, noise in found.items():
        assert noise is not None
        assert weights[name] == pytest.approx(0.3 * noise.total / 0.0125)
    assert 0.3 > weights["rgb"] > 1.5 * weights["nir"] > 1.5 * 0.05
    assert (weights["thermal"], weights["red"]) == (0.3, 0.0)
    assert [note.split(" images")[0] for note in trainer.recipe.notes] == ["Noise of the RGB", "Noise of the NIR"]
    terms = step_gradients(trainer, StepKind(0, densifying=False)).losses
    assert [name for name in terms if name.endswith("smoothness")] == [
        "rgb_smoothness",
        "thermal_smoothness",
        "nir_smoothness",
    ]


def test_frames_without_the_spectrum_are_passed_over(tmp_path: Path) -> None:
    """Noise is that of the images there are; of a spectrum without any there is none to measure."""
    capture = noisy(many_frames(toy_capture(others=("nir",))), nir=8)
    frames = TrainFrames(capture, ("rgb", "nir"), torch.device("cpu"))
    whole = training_noise(frames, "nir")
    capture = dataclasses.replace(capture, train=(*(without(f, "nir") for f in capture.train[:-1]), capture.train[-1]))
    frames = TrainFrames(capture, ("rgb", "nir"), torch.device("cpu"))
    assert training_noise(frames, "nir") == whole  # the same noise in every frame
    assert training_noise(frames, "thermal") is None
