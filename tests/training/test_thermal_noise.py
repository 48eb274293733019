"""The noise of thermal images is measured, stripes included, and smoothness follows it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_run import many_frames, toy_run_config, toy_trainer

from thermosplat.config import LossConfig
from thermosplat.datasets.capture import Capture
from thermosplat.training.thermal_noise import image_noise, smoothness_for_noise
from toy_scene import toy_capture

HEIGHT, WIDTH = 240, 320
MEASURED = LossConfig(thermal_smoothness=0.3, thermal_smoothness_noise=0.0125, thermal_smoothness_least=0.05)


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


@pytest.mark.parametrize("along", [0, 1])
def test_noise_of_stripes(along: int) -> None:
    """What is constant along columns, or rows, is found as stripes, beside the pixels' own noise."""
    torch.manual_seed(0)
    shape = (1, WIDTH, 1) if along == 0 else (HEIGHT, 1, 1)
    noise = image_noise(scene() + 0.01 * torch.randn(shape) + 0.005 * torch.randn(HEIGHT, WIDTH, 3))
    assert noise.stripes == pytest.approx(0.01, rel=0.2)
    assert noise.pixels == pytest.approx(0.005, rel=0.15)
    assert noise.total == pytest.approx((noise.stripes**2 + noise.pixels**2) ** 0.5)


def test_a_clean_image_has_none() -> None:
    """Edges of a scene count for next to nothing."""
    assert image_noise(scene()).total < 1.5e-3


def test_smoothness_rises_with_noise_between_bounds() -> None:
    """In proportion, never above the full weight, and never below the least one."""
    weights = [smoothness_for_noise(MEASURED, noise) for noise in (0.0, 0.001, 0.00625, 0.0125, 0.1)]
    assert weights == pytest.approx([0.05, 0.05, 0.15, 0.3, 0.3])
    assert smoothness_for_noise(dataclasses.replace(MEASURED, thermal_smoothness=0.01), 0.1) == 0.01


def striped(capture: Capture) -> Capture:
    """The capture with thermal images of one temperature and the noise of a bad sensor."""

    def spoilt(frame):  # type: ignore[no-untyped-def]
        image = frame.thermal.image
        noisy = np.random.default_rng(0).normal(128, 8, image.shape).clip(0, 255).astype(np.uint8)
        return dataclasses.replace(frame, thermal=dataclasses.replace(frame.thermal, image=noisy))

    return dataclasses.replace(capture, train=tuple(spoilt(frame) for frame in capture.train))


def test_a_run_takes_what_its_images_ask_for(tmp_path: Path) -> None:
    """It trains with the measured weight and says so; without the setting with the configured one."""
    config = toy_run_config(loss=MEASURED)
    trainer = toy_trainer(tmp_path / "a", config, striped(many_frames(toy_capture())))
    assert trainer.device_step.config.loss.thermal_smoothness == 0.3
    (note,) = trainer.noise_notes
    assert note.startswith("Thermal noise 0.03")
    assert note.endswith("smoothness weight 0.300.")
    assert trainer.config == config
    rgb_alone = toy_run_config(loss=MEASURED, model={"thermal": False})
    assert toy_trainer(tmp_path / "b", rgb_alone, many_frames(toy_capture(thermal=False))).noise_notes == ()
    plain = toy_trainer(tmp_path / "c", toy_run_config(), many_frames(toy_capture()))
    assert plain.noise_notes == ()
    assert plain.device_step.config.loss.thermal_smoothness == 0.3
