"""Errors by region: which pixels count, what is measured of them, and from which Gaussians the depth comes."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from thermosplat.datasets.capture import Capture
from thermosplat.datasets.placement import Placement
from thermosplat.evaluation.labelled_regions import region_columns, region_errors, write_regions
from thermosplat.runs.run_directory import RunDirectory
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.thermal.radiometry import PixelScale
from toy_scene import HEIGHT, WIDTH, toy_capture, toy_config, toy_frame, toy_model

LEFT, MIDDLE, RIGHT = np.s_[:, :8], np.s_[:, 8:16], np.s_[:, 16:]
GLASS, PLASTIC = 1, 4


def capture_with_truth(root: Path, kind: str = "scalar") -> Capture:
    """The toy frame held out: glass on the left (4 for RGB, 2 for thermal), plastic in the middle, sky on the right."""
    label = np.zeros((HEIGHT, WIDTH), np.uint8)
    label[LEFT], label[MIDDLE] = GLASS, PLASTIC
    depth_rgb = np.full((HEIGHT, WIDTH), 4.0, np.float32)
    depth_thermal = depth_rgb.copy()
    depth_thermal[LEFT] = 2.0
    depth_thermal[MIDDLE] = 4.03  # less than 1% away: the same surface
    depth_rgb[RIGHT] = depth_thermal[RIGHT] = 0.0
    (root / "ground_truth").mkdir()
    np.savez(root / "ground_truth" / "a.npz", depth_rgb=depth_rgb, depth_thermal=depth_thermal, label=label)
    capture = toy_capture(thermal_kind=kind)
    return dataclasses.replace(capture, root=root, test=capture.train)


class FixedRender:
    """A model whose images and depths are known beforehand."""

    num_gaussians, placement = 0, Placement()

    def __init__(self, rgb: torch.Tensor, thermal: torch.Tensor | None, depths: dict[str, torch.Tensor]) -> None:
        images = {"rgb": rgb, "thermal": thermal}
        self.images = {name: image for name, image in images.items() if image is not None}
        self.spectra, self.depths, self.device = dict.fromkeys(self.images), depths, rgb.device

    def render(self, views: Any, *, sh_degree: int, shared_cameras: Any) -> RenderedFrame:
        return RenderedFrame(images=self.images)

    def render_depth(self, spectrum: str, view: Any) -> torch.Tensor:
        return self.depths[spectrum]


def images(capture: Capture) -> tuple[torch.Tensor, torch.Tensor]:
    """The held-out frame's images."""
    frame = toy_frame(capture)
    return frame.views["rgb"].image.clone(), frame.views["thermal"].image.clone()


def measured(model: Any, capture: Capture) -> dict[str, Any]:
    regions = region_errors(model, capture, sh_degree=1)
    assert regions is not None
    return regions


def test_every_region_is_judged_by_its_own_pixels(tmp_path: Path) -> None:
    """An error in one region shows there and in the whole, not in the others; sky has no depth."""
    capture = capture_with_truth(tmp_path)
    rgb, thermal = images(capture)
    rgb[LEFT] = (rgb[LEFT] - 0.1).where(rgb[LEFT] > 0.5, rgb[LEFT] + 0.1)
    thermal[MIDDLE] = (thermal[MIDDLE] - 0.2).where(thermal[MIDDLE] > 0.5, thermal[MIDDLE] + 0.2)
    depth = torch.full((HEIGHT, WIDTH), 4.0)
    regions = measured(FixedRender(rgb, thermal, {"rgb": depth + 0.2, "thermal": depth}), capture)

    pixels = HEIGHT * 8
    assert {name: numbers["pixels"] for name, numbers in regions.items()} == {
        "all": 3 * pixels,
        "surfaces differ": pixels,
        "glass": pixels,
        "plastic": pixels,
        "unlabelled": pixels,
    }
    assert regions["glass"]["rgb"]["psnr"] == pytest.approx(20.0, abs=1e-3)
    assert regions["all"]["rgb"]["psnr"] == pytest.approx(20.0 + 10 * math.log10(3), abs=1e-3)
    assert regions["plastic"]["rgb"]["psnr"] is None  # met exactly
    assert regions["plastic"]["thermal"]["mae_celsius"] == pytest.approx(0.2 * 20, abs=1e-3)
    assert regions["glass"]["thermal"]["mae_celsius"] == pytest.approx(0.0, abs=1e-4)

    assert regions["glass"]["rgb"]["depth_error"] == pytest.approx(0.2)
    assert regions["glass"]["rgb"]["depth_error_relative"] == pytest.approx(0.05)
    assert regions["surfaces differ"]["thermal"]["depth_error"] == pytest.approx(2.0)
    assert regions["surfaces differ"]["thermal"]["depth_error_relative"] == pytest.approx(1.0)
    assert regions["plastic"]["thermal"]["depth_error"] == pytest.approx(0.03, abs=1e-6)
    assert regions["glass"]["rgb"]["mae"] == pytest.approx(0.1, abs=1e-6)
    assert regions["plastic"]["thermal"]["mae"] == pytest.approx(0.2, abs=1e-6)
    assert regions["unlabelled"]["rgb"]["depth_error"] is None
    assert regions["unlabelled"]["rgb"]["psnr"] is None


def test_depths_are_compared_in_world_units(tmp_path: Path) -> None:
    """Those of a scene that is trained in units of 0.25 are four times as large as the truth's."""
    capture = capture_with_truth(tmp_path)
    depths = {name: torch.full((HEIGHT, WIDTH), 4 * 4.1) for name in ("rgb", "thermal")}
    model = FixedRender(*images(capture), depths)
    model.placement = Placement(unit=0.25)
    assert measured(model, capture)["glass"]["rgb"]["depth_error"] == pytest.approx(0.1, abs=1e-5)


def test_depth_error_is_the_median(tmp_path: Path) -> None:
    """Of an even number of pixels the median is the mean of the two middle ones, as numpy's."""
    capture = capture_with_truth(tmp_path)
    depth = 4.0 + torch.linspace(0.0, 1.0, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) ** 2
    regions = measured(FixedRender(*images(capture), {"rgb": depth, "thermal": depth}), capture)
    errors = (depth[LEFT].double() - 4.0).numpy()
    assert errors.size % 2 == 0
    assert regions["glass"]["rgb"]["depth_error"] == pytest.approx(np.median(errors), rel=1e-12)


def test_regions_on_a_device(device: torch.device, tmp_path: Path) -> None:
    """Renders on any device give the numbers that they give on the CPU."""
    capture = capture_with_truth(tmp_path, kind="color")
    generator = torch.Generator().manual_seed(3)
    rgb, thermal = (torch.rand(HEIGHT, WIDTH, 3, generator=generator) for _ in range(2))
    depths = {name: 5 * torch.rand(HEIGHT, WIDTH, generator=generator) for name in ("rgb", "thermal")}
    on_cpu = measured(FixedRender(rgb, thermal, depths), capture)
    there = FixedRender(rgb.to(device), thermal.to(device), {name: depth.to(device) for name, depth in depths.items()})
    regions = region_errors(there, capture, sh_degree=1)
    for region, numbers in on_cpu.items():
        assert regions[region]["pixels"] == numbers["pixels"]
        for name in ("rgb", "thermal"):
            for measure, number in numbers[name].items():
                expected = None if number is None else pytest.approx(number, rel=1e-5)
                assert regions[region][name][measure] == expected


def test_depth_is_on_the_right_surface(tmp_path: Path) -> None:
    """Where RGB sees 4 and thermal 2, a depth of 2.5 is thermal's; what is empty is on neither."""
    capture = capture_with_truth(tmp_path)
    depth = torch.full((HEIGHT, WIDTH), 2.5)
    empty = depth.clone()
    empty[: HEIGHT // 2] = 0.0
    regions = measured(FixedRender(*images(capture), {"rgb": depth, "thermal": empty}), capture)
    assert regions["glass"]["rgb"]["on_own_surface"] == 0.0
    assert regions["glass"]["thermal"]["on_own_surface"] == 0.5
    assert regions["plastic"]["rgb"]["on_own_surface"] is None
    assert regions["all"]["thermal"]["on_own_surface"] == 0.5


def test_pixels_of_all_views_count_alike(tmp_path: Path) -> None:
    """A region's number is that of its pixels in all views together, not the mean of the views' numbers."""
    capture = capture_with_truth(tmp_path)
    other = np.load(tmp_path / "ground_truth" / "a.npz")
    label = np.zeros_like(other["label"])
    label[0, 0] = GLASS
    np.savez(tmp_path / "ground_truth" / "b.npz", **{**other, "label": label})
    frame = capture.test[0]
    white = dataclasses.replace(frame.views["rgb"], name="b", image=np.full_like(frame.views["rgb"].image, 255))
    second = dataclasses.replace(frame, views={**frame.views, "rgb": white})
    capture = dataclasses.replace(capture, test=(frame, second))
    rgb, thermal = images(capture)
    depth = torch.full((HEIGHT, WIDTH), 4.0)
    glass = measured(FixedRender(rgb, thermal, {"rgb": depth, "thermal": depth}), capture)["glass"]
    squared = (rgb[0, 0] - 1.0).square().mean().item() / (HEIGHT * 8 + 1)  # the first view is met exactly
    assert glass["pixels"] == HEIGHT * 8 + 1
    assert glass["rgb"]["psnr"] == pytest.approx(-10 * math.log10(squared), rel=1e-5)


def test_no_degrees_and_no_thermal(tmp_path: Path) -> None:
    """Without a temperature range there is no error in °C; a spectrum that is not modelled has no numbers."""
    capture = capture_with_truth(tmp_path, kind="color")
    rgb, thermal = images(capture)
    depths = {"rgb": torch.ones(HEIGHT, WIDTH), "thermal": torch.ones(HEIGHT, WIDTH)}
    unknown = dataclasses.replace(capture.scales["thermal"], range=None)
    no_range = dataclasses.replace(capture, scales={**capture.scales, "thermal": unknown})
    assert measured(FixedRender(rgb, thermal, depths), no_range)["glass"]["thermal"]["mae_celsius"] is None
    assert "thermal" not in measured(FixedRender(rgb, None, depths), capture)["glass"]


@pytest.mark.parametrize("gaussian_sets", ["shared", "separate"])
def test_depth_of_either_spectrum(gaussian_sets: str) -> None:
    """RGB's depth is weighed with α, thermal's with α_t; two sets have a depth each."""
    capture = toy_capture()
    separate = {"gaussian_sets": "separate", "feature_dim": 0, "spectra": {"thermal": {"opacity": "shared"}}}
    model = toy_model(toy_config(**(separate if gaussian_sets == "separate" else {})), capture).eval()
    view = toy_frame(capture).views["rgb"]
    names = ("rgb", "thermal") if gaussian_sets == "separate" else ("shared", "shared")
    with torch.no_grad():
        # two opaque walls: what is before the other one is seen, as far as it is opaque to the spectrum
        for name in dict.fromkeys(names):
            gaussians = model.gaussians(name)
            near = torch.arange(len(gaussians)) % 2 == 0
            gaussians.means[:, 2] = torch.where(near, -2.0, 2.0)
            gaussians.log_scales[:, :2] = 2.0
            gaussians.log_scales[:, 2] = -6.0
            gaussians.quats[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
            gaussians.logit_opacities[:] = 8.0
        if gaussian_sets == "shared":
            model.gaussians("shared").thermal_opacity_offsets[:] = torch.where(near, -40.0, 0.0)
        else:
            model.gaussians("thermal").means[:, 2] = 2.0
        rgb, thermal = model.render_depth("rgb", view), model.render_depth("thermal", view)
    assert rgb.shape == thermal.shape == (HEIGHT, WIDTH)
    torch.testing.assert_close(rgb, torch.full_like(rgb, 2.0), rtol=1e-2, atol=0)  # the camera stands at z = -4
    torch.testing.assert_close(thermal, torch.full_like(thermal, 6.0), rtol=1e-2, atol=0)


def test_file_of_a_real_model(tmp_path: Path) -> None:
    """A real model leaves regions.json with what is returned; without ground truth no file and no numbers."""
    capture = capture_with_truth(tmp_path)
    model, run = toy_model(toy_config(), capture), RunDirectory(tmp_path / "run")
    run.path.mkdir()
    assert write_regions(run, model, toy_capture(), 7, 1) is None
    assert not run.regions_json.exists()
    regions = write_regions(run, model, capture, 7, 1)
    assert json.loads(run.regions_json.read_text()) == {"steps": 7, "regions": regions}
    assert regions["glass"]["thermal"]["depth_error"] > 0
    RunDirectory.create(run.path, overwrite=True)
    assert not run.regions_json.exists()


def test_columns_follow_from_the_numbers() -> None:
    """A table has the spectra and the measures that some region has."""
    numbers = {"psnr": 20.0, "mae": 0.1, "depth_error": 0.2, "depth_error_relative": 0.1, "on_own_surface": 0.5}
    nir = numbers | {"mae_reflectance": 0.05}
    columns = region_columns([{"pixels": 3, "rgb": numbers, "nir": nir}, {"pixels": 4, "rgb": numbers, "nir": None}])
    headings = [column.heading for column in columns]
    assert headings[:3] == ["RGB PSNR [dB]", "NIR PSNR [dB]", "NIR MAE [reflectance]"]
    assert headings[-1] == "NIR on own surface"
    assert columns[2].value({"nir": nir}) == 0.05
    assert columns[2].value({"nir": None}) is None


def test_a_spectrum_without_a_true_depth(tmp_path: Path) -> None:
    """A third spectrum, of which the ground truth has no depth, is judged by its images alone."""
    capture = capture_with_truth(tmp_path)
    frame, rng = capture.test[0], np.random.default_rng(1)
    view = frame.views["rgb"]
    nir = dataclasses.replace(view, spectrum="nir", image=rng.random((HEIGHT, WIDTH, 1), dtype=np.float32))
    scales = {**capture.scales, "nir": PixelScale("scalar")}
    frames = (dataclasses.replace(frame, views={**frame.views, "nir": nir}),)
    capture = dataclasses.replace(capture, test=frames, scales=scales)
    rgb, thermal = images(dataclasses.replace(capture, train=frames))
    depth = torch.full((HEIGHT, WIDTH), 4.0)
    model = FixedRender(rgb, thermal, {"rgb": depth, "thermal": depth})
    model.images["nir"], model.spectra["nir"] = torch.as_tensor(nir.image), None
    regions = measured(model, capture)
    assert regions["glass"]["nir"]["mae"] == 0.0
    assert regions["glass"]["nir"]["depth_error"] is None
    assert regions["glass"]["rgb"]["depth_error"] == 0.0
