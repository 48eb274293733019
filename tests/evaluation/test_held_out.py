"""Evaluation: numbers, their means, the CSV and the pictures."""

import csv
import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from thermosplat.datasets.capture import Capture, Frame
from thermosplat.errors import UserError
from thermosplat.evaluation.held_out import evaluate
from thermosplat.image_quality.metrics import psnr, ssim
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.thermal.radiometry import FLIR_IRON, PixelScale
from toy_scene import HEIGHT, WIDTH, toy_capture, toy_config, toy_frame, toy_model


def held_out(capture: Capture) -> Capture:
    """The toy capture with its one frame held out, twice: as it is, and brighter by a third."""
    frame = capture.train[0]
    rgb = frame.views["rgb"]
    brighter = dataclasses.replace(rgb, image=np.minimum(rgb.image.astype(int) * 4 // 3, 255).astype(np.uint8))
    second = dataclasses.replace(frame, name="b", views={**frame.views, "rgb": brighter})
    return dataclasses.replace(capture, test=(frame, second))


class FixedImages:
    """A model whose images are known beforehand."""

    num_gaussians = 7

    def __init__(self, rgb: torch.Tensor | None, thermal: torch.Tensor | None) -> None:
        images = {"rgb": rgb, "thermal": thermal}
        self.images = {name: image for name, image in images.items() if image is not None}
        self.spectra = dict.fromkeys(self.images)
        self.device = next(iter(self.images.values())).device

    def render(self, views: Any, *, sh_degree: int, shared_cameras: Any) -> RenderedFrame:
        return RenderedFrame(images={name: image for name, image in self.images.items() if name in views})


def run(model: Any, capture: Capture, **options: Any) -> dict[str, Any]:
    return evaluate(model, capture, sh_degree=1, **options)


@pytest.mark.parametrize("kind", ["color", "scalar"])
def test_temperature_error(kind: str) -> None:
    """A render 0.1 of the range too hot is 2 °C off, for scalars exactly, through the palette nearly."""
    capture = toy_capture(thermal_kind=kind)
    frame = capture.train[0]
    intensity = np.linspace(0.1, 0.8, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    image = intensity[..., None] if kind == "scalar" else np.round(FLIR_IRON.to_color(intensity) * 255).astype(np.uint8)
    view = dataclasses.replace(frame.views["thermal"], image=image, values=10.0 + 20.0 * intensity)
    views = {**frame.views, "thermal": view}
    capture = dataclasses.replace(capture, test=(dataclasses.replace(frame, views=views),))
    hotter = torch.as_tensor(intensity + 0.1)
    render = hotter[..., None] if kind == "scalar" else torch.as_tensor(FLIR_IRON.to_color(hotter.numpy()))
    metrics = run(FixedImages(torch.zeros(HEIGHT, WIDTH, 3), render), capture)
    assert metrics["thermal"]["mae_celsius"] == pytest.approx(2.0, abs=1e-4 if kind == "scalar" else 0.02)


def test_masked_pixels_do_not_count(tmp_path: Path) -> None:
    """Whatever is rendered there: all numbers and the strip are those of the other pixels."""
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[:, WIDTH // 2 :] = False

    def masked(frame: Frame) -> Frame:
        thermal = frame.views["thermal"]
        values = np.where(mask, np.float32(20), np.float32(np.nan))
        views = {"rgb": frame.views["rgb"], "thermal": dataclasses.replace(thermal, values=values)}
        return dataclasses.replace(frame, views={n: dataclasses.replace(v, mask=mask) for n, v in views.items()})

    capture = toy_capture(thermal_kind="scalar")
    capture = dataclasses.replace(capture, test=tuple(map(masked, capture.train)))
    seen = torch.as_tensor(mask)[..., None]
    found = []
    for beyond in (0.0, 1.0):
        images = [torch.where(seen, 0.5, beyond).expand(-1, -1, channels) for channels in (3, 1)]
        folder = tmp_path / str(beyond)
        found.append(run(FixedImages(*images), capture, lpips=lambda one, other: float((one - other).mean())))
        run(FixedImages(*images), capture, strips_dir=folder)
    assert found[0] == found[1]
    assert found[0]["thermal"]["mae_celsius"] is not None
    strips = [cv2.imread(str(next((tmp_path / name).glob("*.png")))) for name in ("0.0", "1.0")]
    assert (strips[0] != strips[1]).any()  # the render itself is shown as it is
    half = torch.full((HEIGHT, WIDTH, 3), 0.5)
    target = torch.as_tensor(capture.test[0].views["rgb"].image / 255.0, dtype=torch.float32)
    assert found[0]["rgb"]["psnr"] == pytest.approx(psnr(half[:, : WIDTH // 2], target[:, : WIDTH // 2]), abs=1e-4)


def test_means_csv_and_clamping(tmp_path: Path) -> None:
    """Numbers are those of the clamped image; means are means of the views; the CSV has a row for each view."""
    capture = held_out(toy_capture())
    render = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0)) * 2 - 0.5
    thermal = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    metrics = run(FixedImages(render, thermal), capture, csv_path=tmp_path / "per_view.csv")
    targets = [torch.as_tensor(frame.views["rgb"].image / 255.0, dtype=torch.float32) for frame in capture.test]
    for name, metric in (("psnr", psnr), ("ssim", ssim)):
        expected = np.mean([metric(render.clamp(0, 1), target) for target in targets])
        assert metrics["rgb"][name] == pytest.approx(expected, rel=1e-6)
    assert metrics["rgb"]["lpips"] is None
    assert metrics["num_gaussians"] == 7
    rows = list(csv.DictReader((tmp_path / "per_view.csv").open()))
    assert [(row["frame"], row["spectrum"]) for row in rows] == [
        *(("a", "rgb"), ("a", "thermal"), ("b", "rgb"), ("b", "thermal"))
    ]
    assert float(rows[0]["psnr"]) != float(rows[2]["psnr"])
    assert np.mean([float(row["psnr"]) for row in rows[::2]]) == pytest.approx(metrics["rgb"]["psnr"])
    assert rows[0]["lpips"] == rows[0]["mae_celsius"] == ""
    assert float(rows[1]["mae_celsius"]) > 0


def test_lpips_is_asked_for_every_spectrum() -> None:
    """A given LPIPS fills its column with the mean of what it returns; views too small for it stay null."""
    capture = held_out(toy_capture())
    model = FixedImages(torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH, 3))
    answers = iter([0.1, None, 0.3, None])
    metrics = run(model, capture, lpips=lambda render, target: next(answers))
    assert metrics["rgb"]["lpips"] == pytest.approx(0.2)
    assert metrics["thermal"]["lpips"] is None


def test_no_degrees_no_error_in_degrees() -> None:
    """Without a temperature range, or without measured temperatures, the error in °C is null."""
    capture = held_out(toy_capture())
    model = FixedImages(torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH, 3))
    scales = {**capture.scales, "thermal": PixelScale("color", FLIR_IRON, None, "celsius")}
    no_range = dataclasses.replace(capture, scales=scales)
    assert run(model, no_range)["thermal"]["mae_celsius"] is None
    frames = tuple(
        dataclasses.replace(f, views={**f.views, "thermal": dataclasses.replace(f.views["thermal"], values=None)})
        for f in capture.test
    )
    assert run(model, dataclasses.replace(capture, test=frames))["thermal"]["mae_celsius"] is None


def test_equal_images_do_not_swallow_the_mean() -> None:
    """A view met exactly has no finite PSNR and is left out of its mean."""
    capture = held_out(toy_capture())
    exact = torch.as_tensor(capture.test[0].views["rgb"].image / 255.0, dtype=torch.float32)
    metrics = run(FixedImages(exact, torch.zeros(HEIGHT, WIDTH, 3)), capture)
    assert np.isfinite(metrics["rgb"]["psnr"])


def test_missing_spectrum(tmp_path: Path) -> None:
    """A spectrum that is not modelled has no numbers, one without held-out views is null; others are evaluated."""
    capture = held_out(toy_capture())
    metrics = run(FixedImages(torch.zeros(HEIGHT, WIDTH, 3), None), capture, strips_dir=tmp_path)
    assert metrics["spectra"] == ["rgb"]
    assert "thermal" not in metrics
    assert metrics["rgb"]["psnr"] > 0
    assert len(list(tmp_path.iterdir())) == 2
    both = FixedImages(torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH, 3))
    none_held_out = run(both, dataclasses.replace(capture, test=()))
    assert none_held_out["rgb"] is None
    assert none_held_out["thermal"] is None
    assert none_held_out["spectra"] == ["rgb", "thermal"]


def test_values_of_another_unit(tmp_path: Path) -> None:
    """Near infrared in reflectance has an error in reflectance, in the numbers, the CSV and the strip."""
    capture = toy_capture(others=("nir",))
    capture = dataclasses.replace(capture, test=capture.train)
    model = FixedImages(torch.zeros(HEIGHT, WIDTH, 3), None)
    truth = torch.as_tensor(capture.test[0].views["nir"].image)
    model.images["nir"] = truth.clamp(max=0.9) + 0.1
    model.spectra["nir"] = None
    metrics = run(model, capture, csv_path=tmp_path / "per_view.csv", strips_dir=tmp_path / "strips")
    expected = (truth.clamp(max=0.9) + 0.1 - truth).abs().mean().item()
    assert metrics["nir"]["mae_reflectance"] == pytest.approx(expected, rel=1e-5)
    assert "mae_reflectance" not in metrics["rgb"]
    rows = list(csv.DictReader((tmp_path / "per_view.csv").open()))
    assert [row["mae_reflectance"] == "" for row in rows] == [True, False]
    assert len(list((tmp_path / "strips").iterdir())) == 1


def test_strips_that_cannot_be_written(tmp_path: Path) -> None:
    """A folder for the strips that is a file is the user's to mend, and says so."""
    (tmp_path / "strips").touch()
    model = FixedImages(torch.zeros(HEIGHT, WIDTH, 3), None)
    with pytest.raises(UserError, match="Could not write"):
        run(model, held_out(toy_capture()), strips_dir=tmp_path / "strips")


def test_degrees_are_measured_on_the_device(device: torch.device, tmp_path: Path) -> None:
    """Numbers and strips of images on any device; through the palette, as on the CPU."""
    capture = held_out(toy_capture())
    generator = torch.Generator().manual_seed(2)
    images = [torch.rand(HEIGHT, WIDTH, 3, generator=generator) for _ in range(2)]
    options = {"sh_degree": 1, "lpips": lambda render, target: (render - target).abs().mean().item()}
    on_cpu = evaluate(FixedImages(*images), capture, **options)
    there = FixedImages(*(image.to(device) for image in images))
    metrics = evaluate(there, capture, strips_dir=tmp_path, **options)
    for name in ("rgb", "thermal"):
        # abs: the SSIM of unrelated images is about 0, as a mean of float32 numbers of order 1
        assert metrics[name] == pytest.approx(on_cpu[name], rel=1e-5, abs=1e-6)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("aligned", [True, False])
def test_strips_of_a_real_model(aligned: bool, tmp_path: Path) -> None:
    """A real model is rendered without gradients; each frame leaves one PNG with a row for each spectrum."""
    capture = held_out(toy_capture(aligned=aligned))
    model = toy_model(toy_config(), capture)
    metrics = run(model, capture, strips_dir=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]
    strip = cv2.imread(str(tmp_path / "a.png"))
    rows = [240 * HEIGHT // WIDTH, 240 * HEIGHT // WIDTH if aligned else 240 * 14 // 16]
    assert strip.shape[0] == sum(rows) + 2 * 20 + 4
    assert strip.shape[1] > 3 * 240 + 2 * 4  # and the colour bar of the temperatures
    frame = toy_frame(capture)
    rendered = model.render(frame.views, sh_degree=1)
    one = dataclasses.replace(capture, test=capture.test[:1])
    assert run(model, one)["rgb"]["psnr"] == pytest.approx(
        psnr(rendered.images["rgb"].detach(), frame.views["rgb"].image), rel=1e-5
    )
    assert all(parameter.grad is None for parameter in model.parameters())
    assert metrics["num_gaussians"] == 60
