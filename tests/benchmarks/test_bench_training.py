"""The training benchmark runs on something far too small to measure anything, and its arithmetic is what it claims."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from bench_training import main
from device_peaks import DevicePeaks
from gsplat_rgbt_adapter import Gsplat, GsplatTraining
from random_training_scene import random_capture, random_gaussians
from steady_training import run_steps, steady_config, steady_trainer
from step_kernels import milliseconds_by_part, part_of
from step_parts import LOSSES
from torch import Tensor
from training_peers import disagreement
from training_runs import differences, memory_growth
from training_step_case import memory_model, random_case
from training_step_floors import decoder_fmas
from training_tables import markdown

from reference_projection import spherical_harmonics
from thermosplat import rasterization
from thermosplat.config import DecoderConfig, TrainConfig
from thermosplat.decoders import Decoders
from thermosplat.run_directory import RunDirectory
from thermosplat.training.trainer import Trainer
from thermosplat.training.training_step import StepKind

CONFIG = TrainConfig(device="cpu", sh_degree=2)
PARTS = {
    "rasterization",
    "decoders",
    "finite check",
    "optimizer",
    "densification",
    *(f"loss {name}" for name in LOSSES),
}


@pytest.fixture
def trainer(tmp_path: Path) -> Trainer:
    """A trainer on noise, ready to step."""
    gaussians = random_gaussians(300, feature_dim=8, sh_degree=2)
    config = steady_config(CONFIG, densifying=True)
    return steady_trainer(config, random_capture(32, 24), tmp_path / "run", gaussians=gaussians)


def test_steady_steps_find_the_same_gaussians(trainer: Trainer) -> None:
    """Steps change neither Gaussians nor decoders, use all degrees, and note gradients for density control."""
    before = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    run_steps(trainer, 3)
    assert trainer.sh_degree == 2
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.state_dict().items())
    assert trainer.state.strategies["shared"].observations.max() == 3
    assert trainer.state.optimizers["shared"]["means"].state[trainer.model.gaussians("shared").means]["exp_avg"].any()


def test_two_calls_of_a_rasterizer_give_the_same_losses_and_gradients(trainer: Trainer) -> None:
    """The adapter around a function of gsplat's signature (ours) does what one traversal of both spectra does."""

    def harmonics(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
        basis = spherical_harmonics(torch.nn.functional.normalize(directions, dim=-1), degree)
        return (basis[..., None] * coefficients[:, : basis.shape[-1]]).sum(1)

    frame = trainer.frames[0]
    done = trainer.device_step.gradients(frame, StepKind(2, densifying=False), fixed_capacity=False)
    gaussians = trainer.model.gaussians("shared")
    expected = {name: parameter.grad.clone() for name, parameter in gaussians.named_parameters()}
    trainer.state.clear_gradients()
    training = GsplatTraining(trainer.model, trainer.config, 2, Gsplat("ours", rasterization, harmonics, {}))
    losses = training.losses(frame)
    assert losses.keys() == done.losses.keys()
    for name, loss in losses.items():
        torch.testing.assert_close(loss, done.losses[name], rtol=1e-5, atol=1e-7)
    torch.stack(list(losses.values())).sum().backward()
    for name, parameter in gaussians.named_parameters():
        error = (parameter.grad - expected[name]).norm() / expected[name].norm()
        assert error < 1e-4, name
    before = gaussians.means.detach().clone()
    training.step(frame)
    assert torch.equal(gaussians.means, before)
    assert gaussians.means.grad is None


def test_every_part_of_a_step_has_a_time_and_a_floor() -> None:
    """Parts, floors and operators of a step on random Gaussians."""
    peaks = DevicePeaks(1e10, 1e11, 1e11, 1e11)
    case = random_case(CONFIG, (32, 24), 200, peaks, steps=1, repeats=1)
    assert "parts_error" not in case
    assert set(case["parts"]) == PARTS
    assert all(part["forward_ms"] > 0 and part["floor"]["floor_ms"] > 0 for part in case["parts"].values())
    assert case["floor_ms"] == pytest.approx(sum(part["floor"]["floor_ms"] for part in case["parts"].values()))
    # mean, rotation, scales, opacity, 9 spherical harmonics, features and thermal offset: 47 floats of 28 bytes
    assert case["parts"]["optimizer"]["floor"]["floor_ms"] == pytest.approx(1e3 * 200 * 47 * 28 / 1e10)
    assert case["parts"]["rasterization"]["floor"]["pairs"] > 200
    assert (case["gaussians"], case["width"], case["height"]) == (200, 32, 24)
    times = [kernel["microseconds"] for kernel in case["kernels"]]
    assert times == sorted(times, reverse=True)


def test_decoder_operations_are_counted_by_branch() -> None:
    """Shared layers and the prior are passed twice, modulation and heads once."""
    decoders = Decoders(DecoderConfig(hidden_dim=4, hidden_layers=2), feature_dim=8, thermal_channels=1)
    assert decoder_fmas(decoders) == 2 * (8 * 4 + 4 * 4 + 4 * 4) + 4 * 8 + 4 * 3 + 4 * 1
    plain = Decoders(DecoderConfig(hidden_dim=4, hidden_layers=1, modulation=False), feature_dim=8, thermal_channels=1)
    assert decoder_fmas(plain) == 2 * 8 * 4 + 4 * 4 + 4 * 3 + 4 * 1


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("project_pinhole_quats_float32_1f00_cuda_kernel_forward", "rasterization forward"),
        ("project_adjoint_pinhole_quats_float32_1f00_cuda_kernel_forward", "rasterization backward"),
        ("blend_11_8_float32_8x4_1f00_cuda_kernel_forward", "rasterization forward"),
        ("blend_adjoint_11_8_float32_8x4_1f00_cuda_kernel_forward", "rasterization backward"),
        (
            "void cub::CUB_300001_SM_900::detail::radix_sort::DeviceRadixSortOnesweepKernel<...>",
            "rasterization forward",
        ),
        ("image_loss_blur_columns_adjoint_float32_1f00_cuda_kernel_forward", "image losses"),
        ("forward_kernel", "decoders"),
        ("adam_update_1f00_cuda_kernel_forward", "optimizer"),
        ("Memcpy DtoD (Device -> Device)", "copies"),
        ("void at::native::vectorized_elementwise_kernel<4, ...>", "others"),
    ],
)
def test_kernels_are_told_by_their_names(name: str, part: str) -> None:
    """A forward kernel is not taken for its adjoint, nor the other way round."""
    assert part_of(name) == part
    assert milliseconds_by_part([{"name": name, "microseconds": 1500.0}] * 2) == {part: 3.0}


def test_memory_is_divided_between_gaussians_and_pixels() -> None:
    """The fit finds the bytes that peaks were made of; too few cases have none."""
    cases = [
        {"gaussians": n, "width": w, "height": 100, "memory": {"allocated_bytes": 2000 * n + 700 * w * 100 + 5_000_000}}
        for n in (10_000, 50_000)
        for w in (200, 600)
    ]
    fit = memory_model(cases)
    assert fit is not None
    found = [fit[name] for name in ("bytes_per_gaussian", "bytes_per_pixel", "bytes_besides")]
    assert found == pytest.approx([2000, 700, 5_000_000])
    assert fit["largest_relative_error"] < 1e-9
    assert memory_model(cases[:3]) is None
    assert memory_model([case | {"memory": None} for case in cases]) is None


def test_memory_growth_starts_where_gaussians_stopped_to_come(tmp_path: Path) -> None:
    """Growth with the number of Gaussians is none; a later rise is."""
    run = RunDirectory.create(tmp_path / "run")
    rows = [(100, 10, 50), (200, 20, 80), (300, 30, 90), (400, 30, 95), (500, 30, 95), (600, 30, 99)]
    lines = [dict(zip(("step", "num_gaussians", "memory_bytes"), row)) for row in rows]
    run.metrics_jsonl.write_text("".join(json.dumps(line) + "\n" for line in [*lines, {"step": 600, "evaluation": {}}]))
    growth = memory_growth(run)
    assert growth["late_from_step"] == 400
    assert growth["late_growth_bytes"] == 4
    assert [sample["step"] for sample in growth["samples"]] == [100, 200, 300, 400, 500, 600]


def test_variants_are_compared_by_seed() -> None:
    """PSNR differences to the plain loop of the same seed, and bits of both deterministic runs."""

    def run(variant: str, seed: int, psnr: float, bits: str = "") -> dict[str, Any]:
        return {"variant": variant, "seed": seed, "rgb_psnr": psnr, "thermal_psnr": None, "model_hash": bits}

    runs = [
        run("default", 1, 20.5),
        run("plain", 1, 20.25),
        run("default", 2, 21.0),
        {"variant": "plain", "error": "x"},
    ]
    thermal = [row | {"thermal_psnr": 30.0} for row in runs[:2]]
    assert differences(runs)["to_plain"] == {"1": {"rgb_psnr": 0.25, "thermal_psnr": None}}
    assert differences(thermal)["to_plain"]["1"]["thermal_psnr"] == 0.0
    assert differences(runs)["deterministic_equal"] is None
    twice = [run("deterministic", 1, 20.0, "a"), run("deterministic", 1, 20.0, "b")]
    assert differences(twice)["deterministic_equal"] is False


def test_losses_that_differ_are_named() -> None:
    """A term beyond the tolerance, or not a number, is a disagreement."""
    agreeing = {"rgb": {"relative_difference": 1e-5, "timed_relative_difference": 1e-2}}
    assert disagreement(agreeing) is None
    apart = disagreement(agreeing | {"thermal": agreeing["rgb"] | {"relative_difference": float("nan")}})
    assert apart is not None
    assert "thermal" in apart
    assert "rgb" not in apart


def test_whole_training_and_steps_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A training by the command is timed and its Gaussians are taken for the steps; the files hold both."""
    report, table = tmp_path / "report.json", tmp_path / "report.md"
    words = [
        "sample",
        "--config",
        "demo",
        "--device",
        "cpu",
        "--parts",
        "whole",
        "peers",
        "--seeds",
        "3",
        "--no-gsplat",
    ]
    words += ["--windows", "1", "--window", "1", "--json", str(report), "--markdown", str(table)]
    assert main([*words, "--", "--max-steps", "3", "--data-factor", "8", "--log-every", "1"]) == 0
    written = json.loads(report.read_text())
    (run,) = written["whole"]["runs"]
    assert run["steps"] == 3
    assert 0 < run["first_step_seconds"] < run["train_seconds"] < run["seconds"] < run["process_seconds"] + 1
    assert run["compiled_seconds"] == run["seconds"] - run["first_step_seconds"] - run["late_compile_seconds"]
    assert 0 <= run["late_compile_seconds"] <= run["compile_seconds"]
    assert min(run["rgb_psnr"], run["thermal_psnr"]) > 5
    assert written["peers"]["gaussians"] == run["num_gaussians"]
    assert set(written["peers"]["steps"]) == {"thermosplat", "thermosplat 3dgs, RGB alone"}
    assert written["peers"]["steps"]["thermosplat"]["times_ours"] == 1
    assert "Whole trainings" in capsys.readouterr().out
    assert table.read_text() == markdown(written)


def test_time_limit_and_failures_leave_a_whole_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """After the limit nothing is started; a training that fails is a row, and the exit code."""
    report = tmp_path / "report.json"
    words = ["sample", "--device", "cpu", "--json", str(report)]
    assert main([*words, "--time-limit", "0"]) == 0
    assert "came before the steps side by side" in json.loads(report.read_text())["stopped"]
    assert "time limit" in capsys.readouterr().out
    assert main([*words, "--parts", "whole", "--", "--max-steps", "0"]) == 1
    assert "max-steps" in json.loads(report.read_text())["whole"]["runs"][0]["error"]
