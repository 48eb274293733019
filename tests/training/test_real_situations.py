"""The default learns what people come with: few points, other units, wrong poses, light that changes, and so on."""

from dataclasses import replace
from pathlib import Path

import pytest

from scenes.real_situations import SITUATIONS, situation
from thermosplat.config.files import load_config
from thermosplat.datasets import load_capture
from thermosplat.evaluation.training_views import LEARNT
from toy_run import toy_trainer

LOST = {"rgb": {"8 views": 6.0, "two stops": 8.0}, "thermal": {"8 views": 6.0, "moving person": 6.0}}
"""Decibels that held-out views may lose beside the capture as it is; 4 where nothing is said."""


@pytest.fixture(scope="module")
def as_it_is(tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    """Held-out PSNR of the sample capture, half the size, by spectrum [dB]."""
    return trained("as it is", tmp_path_factory.mktemp("as_it_is"))


def trained(name: str, folder: Path) -> dict[str, float]:
    """Held-out PSNR of a short training of the default on a situation, which must have been learnt."""
    capture = load_capture(situation(load_capture("sample", data_factor=2), name, folder / "capture"))
    preset = load_config("thermosplat_plus")
    density = replace(preset.densification, max_gaussians=6000)
    config = replace(preset, steps_scaler=0.08, scenes=1, densification=density, steps_for_views=None, device="cpu")
    metrics = toy_trainer(folder / "run", config, capture).train()
    assert metrics["num_gaussians"] > 500
    for spectrum, numbers in metrics["training_views"].items():
        assert numbers["psnr"] > numbers["one_color_psnr"] + LEARNT, spectrum
    return {spectrum: metrics[spectrum]["psnr"] for spectrum in metrics["spectra"]}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SITUATIONS if name != "as it is"])
def test_no_situation_is_lost(name: str, tmp_path: Path, as_it_is: dict[str, float]) -> None:
    """All that is trained is learnt, and held-out views are not far below those of the capture as it is."""
    (tmp_path / "capture").mkdir()
    for spectrum, value in trained(name, tmp_path).items():
        if (name, spectrum) != ("hot lamp", "thermal"):  # of another range
            assert value > as_it_is[spectrum] - LOST[spectrum].get(name, 4.0), spectrum
