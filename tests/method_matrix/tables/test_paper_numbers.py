"""The paper's numbers agree with each other and with our presets."""

import statistics

import pytest

from thermosplat.config.files import preset_paths
from thermosplat.method_matrix.tables.paper_numbers import (
    MEANS,
    METHODS,
    SCENE_PSNR,
    SCENES,
    paper_mean,
    paper_scene,
    paper_value,
)


def test_scenes_average_to_the_reported_mean() -> None:
    """The ten PSNR values of ThermoSplat have the mean that the paper prints, in both spectra."""
    for spectrum, by_scene in SCENE_PSNR["thermosplat"].items():
        assert set(by_scene) == set(SCENES)
        assert statistics.fmean(by_scene.values()) == pytest.approx(MEANS["thermosplat"][spectrum].psnr, abs=0.006)


def test_the_papers_method_is_ahead_of_all_it_reports() -> None:
    """In every measure of both spectra; by at most 2 dB, and in the range of the measure."""
    for method, means in MEANS.items():
        for spectrum, numbers in means.items():
            best = MEANS["thermosplat"][spectrum]
            assert best.psnr - 2 < numbers.psnr <= best.psnr, (method, spectrum)
            assert 0.8 < numbers.ssim <= best.ssim, (method, spectrum)
            assert best.lpips <= numbers.lpips < 0.25, (method, spectrum)


def test_methods_are_presets() -> None:
    """Every row of the paper has a preset of ours."""
    assert set(MEANS) <= set(METHODS) <= set(preset_paths())


def test_scenes_are_recognised_by_name() -> None:
    """Whatever capitals and underscores a folder has."""
    assert paper_scene("Rotary_Kiln") == "RotaryKiln"
    assert paper_scene("shed") is None
    assert paper_value("thermosplat", "thermal", "psnr", "rotary_kiln") == 28.48
    assert paper_value("thermosplat", "thermal", "ssim", "RotaryKiln") is None
    assert paper_value("3dgs", "rgb", "psnr", "Truck") is None
    assert paper_value("thermosplat", "nir", "psnr", "Truck") is None


def test_mean_is_that_of_all_ten() -> None:
    """The paper's mean stands beside ours only where the scenes are the same."""
    assert paper_mean("mmone", "rgb", "lpips", list(SCENES)) == 0.209
    assert paper_mean("mmone", "rgb", "psnr", list(SCENES[:9])) is None
    assert paper_mean("mmone", "thermal", "mae_celsius", list(SCENES)) is None
    assert paper_mean("thermalgaussian_msmg", "rgb", "psnr", list(SCENES)) is None
    assert paper_mean("mmone", "nir", "psnr", list(SCENES)) is None
