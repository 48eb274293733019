"""What a step of a model costs, part by part, follows from its spectra, whichever and however many there are."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from measuring.device_peaks import DevicePeaks
from thermosplat.config import TrainConfig
from thermosplat.config.files import load_config
from thermosplat.training.trainer import Trainer
from toy_scene import with_spectra
from training.frozen_training import ENDLESS, frozen_trainer, run_steps, synthetic_capture, synthetic_gaussians
from training.parts_alone import parts_alone
from training.step_floors import LOSS_BYTES, step_floors
from training.tables import markdown

WIDTH, HEIGHT, COUNT = 32, 24, 150
PEAKS = DevicePeaks(1e12, 2e12, 2e12, 2e12)
NIR: dict[str, dict[str, Any]] = {"nir": {"opacity": "own", "smoothness": 0.1}}


def trainer_of(config: TrainConfig, path: Path) -> Trainer:
    """A frozen trainer on random Gaussians and images of the configuration's spectra."""
    gaussians = synthetic_gaussians(COUNT, config.model.feature_dim, config.sh_degree, config.modelled)
    capture = synthetic_capture(WIDTH, HEIGHT, config.modelled)
    return frozen_trainer(replace(config, device="cpu"), capture, path, gaussians=gaussians)


def test_random_captures_have_the_images_that_are_modelled(tmp_path: Path) -> None:
    """A photograph, pseudo-colours and values, of one camera; steps of all of them run."""
    config = with_spectra(load_config("thermosplat"), **NIR)
    trainer = trainer_of(config, tmp_path)
    views = trainer.frames[0].views
    assert {name: tuple(view.image.shape) for name, view in views.items()} == {
        "rgb": (HEIGHT, WIDTH, 3),
        "thermal": (HEIGHT, WIDTH, 3),
        "nir": (HEIGHT, WIDTH, 1),
    }
    assert trainer.frames[0].shared_cameras == (("rgb", "thermal", "nir"),)
    assert trainer.model.gaussians("shared").second_opacities == ("thermal", "nir")
    run_steps(trainer, 1)
    assert trainer.guard.first_bad() is None


def test_frozen_configurations_train_all_spectra_at_every_step(tmp_path: Path) -> None:
    """Phases and starts from another set are left out: each step does the same work."""
    trainer = trainer_of(load_config("thermalgaussian_mftg"), tmp_path)
    assert {tuple(trainer.schedule.tensors(step).views) for step in (0, ENDLESS // 2, ENDLESS - 1)} == {
        ("rgb", "thermal")
    }
    assert {spectrum.start for spectrum in trainer.config.spectra.values()} == {"points"}


def test_floors_of_three_spectra(tmp_path: Path) -> None:
    """A third spectrum adds its decoder, its two terms and its traversal, which has no SH colours."""
    two, three = (
        step_floors(trainer_of(config, tmp_path / name), PEAKS)[0]
        for name, config in (
            ("two", load_config("thermosplat")),
            ("three", with_spectra(load_config("thermosplat"), **NIR)),
        )
    )
    pixels = WIDTH * HEIGHT
    channels = 3 + 3 + 3 + 1  # both images, and the channels that are compared with them
    assert two["image losses"]["bytes"] == LOSS_BYTES * pixels * channels
    assert three["image losses"]["bytes"] == LOSS_BYTES * pixels * (channels + 1 + 1)
    weights = 8 * 64 + 64 * 64 + 64 * 64  # encoder and prior
    rgb, thermal, nir = 64 * 128 + 64 * 3, 64 * 3, 64
    assert two["decoders"]["operations"] == 3 * pixels * (2 * weights + rgb + thermal)
    assert three["decoders"]["operations"] == 3 * pixels * (3 * weights + rgb + thermal + nir)
    assert three["SH"] == two["SH"]
    assert three["blending"]["operations"] > two["blending"]["operations"]
    assert three["projection"]["bytes"] > 1.5 * two["projection"]["bytes"]


def test_branches_count_the_layers_that_they_use(tmp_path: Path) -> None:
    """Without modulation RGB does not see the prior; networks of their own are counted once each."""
    pixels, first = WIDTH * HEIGHT, 8 * 64 + 64 * 64
    plain = step_floors(trainer_of(load_config("mlp_based"), tmp_path / "plain"), PEAKS)[0]
    assert plain["decoders"]["operations"] == 3 * pixels * (2 * first + 64 * 64 + 2 * 64 * 3)
    config = load_config("ms_splatting")
    dim, hidden = config.model.feature_dim + 3, config.decoder.hidden_dim
    separate = step_floors(trainer_of(config, tmp_path / "separate"), PEAKS)[0]
    of_one = dim * hidden + hidden * hidden + 3 * hidden
    assert separate["decoders"]["operations"] == 3 * pixels * 2 * of_one


@pytest.mark.parametrize(("feature_dim", "sets"), [(0, "shared"), (0, "separate")])
def test_floors_of_spectra_without_features(feature_dim: int, sets: Any, tmp_path: Path) -> None:
    """Two spectra of one traversal blend six channels, every other three; all have SH colours."""
    config = with_spectra(load_config("3dgs"), **NIR)
    config = replace(config, model=replace(config.model, feature_dim=feature_dim, gaussian_sets=sets))
    floors, work = step_floors(trainer_of(config, tmp_path), PEAKS)
    assert {"SH", "SH adjoint", "blending", "projection"} <= floors.keys()
    assert "decoders" not in floors
    assert floors["image losses"]["bytes"] == LOSS_BYTES * WIDTH * HEIGHT * (3 + 3 + 1)
    assert work["pairs"] > 0


def test_parts_alone_are_the_terms_of_the_loss(tmp_path: Path) -> None:
    """Each term of each spectrum by its name, with the floor of the channels that it compares."""
    trainer = trainer_of(with_spectra(load_config("thermosplat"), **NIR), tmp_path)
    run_steps(trainer, 1)
    found = parts_alone(trainer, PEAKS, 1)
    losses = {name.removeprefix("loss "): part for name, part in found.items() if name.startswith("loss ")}
    assert list(losses) == [
        *("rgb", "thermal", "nir", "features_rgb", "features_thermal", "features_nir"),
        *("thermal_smoothness", "nir_smoothness"),
    ]
    of_channel = 1e3 * WIDTH * HEIGHT / PEAKS.bytes_per_s
    floors = {name: part["floor_ms"] / of_channel for name, part in losses.items()}
    assert floors == pytest.approx(
        {
            **{"rgb": 60, "thermal": 60, "nir": 20, "features_rgb": 60, "features_thermal": 20, "features_nir": 20},
            **{"thermal_smoothness": 36, "nir_smoothness": 12},
        }
    )
    assert all(part["forward_ms"] > 0 for part in losses.values())


def test_tables_have_a_column_per_spectrum() -> None:
    """Of all runs together; a run without one has a dash."""
    row = {
        **{"kind": "default", "seed": 1, "seconds": 9.0, "first_step_s": 1.0, "late_compile_s": 0.0},
        **{"seconds_without_compilation": 8.0, "ms_a_step": 2.0, "num_gaussians": 100, "memory": []},
    }
    rows = [row | {"psnr": {"rgb": 20.0}}, row | {"psnr": {"rgb": 21.0, "nir": 30.0}}]
    report = {"environment": {"device": "a device", "packages": {}}, "date": "today", "command": "x"}
    text = markdown(report | {"whole": rows, "errors": {}, "stopped": []})
    assert "| PSNR RGB | PSNR NIR |" in text
    assert "| 20.00 | - |" in text
    assert "| 21.00 | 30.00 |" in text
