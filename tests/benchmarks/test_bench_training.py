"""bench_training.py runs, on a capture far too small to measure anything, and what it measures with is right."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmark_scripts import REPOSITORY, run_script
from reference_projection import spherical_harmonics
from thermosplat import rasterization
from thermosplat.config.files import load_config
from thermosplat.training.density.gaussian_ops import prune
from toy_scene import with_spectra

PARTS = {"projection", "SH", "blending", "decoders", "image losses", "blending adjoint", "optimizer", "rest"}


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A report of all parts, and the tables."""
    folder = tmp_path_factory.mktemp("bench")
    options = ["sample", "--device", "cpu", "--warm-steps", "2", "--window", "1", "--rounds", "2"]
    options += ["--sizes", "48x36", "--counts", "400", "--kernels", "2"]
    files = ["--json", str(folder / "report.json"), "--markdown", str(folder / "report.md")]
    flags = ["--config", "demo", "--data-factor", "8", "--max-steps", "3", "--log-every", "1"]
    done = run_script("bench_training.py", *options, *files, "--", *flags)
    assert done.returncode == 0, done.stdout + done.stderr
    written = json.loads((folder / "report.json").read_text())
    return written | {"stdout": done.stdout, "tables": (folder / "report.md").read_text()}


@pytest.mark.slow
def test_whole_runs_are_timed_and_judged(report: dict[str, Any]) -> None:
    """A run has its seconds, steps, quality, and memory at shares of its steps."""
    (row,) = report["whole"]
    assert (row["kind"], row["seed"], row["steps"]) == ("default", 42, 3)
    assert row["seconds"] >= row["train_s"] >= row["first_step_s"] > 0
    assert 0 <= row["late_compile_s"] <= row["compile_s"]
    apart = row["first_step_s"] + row["late_compile_s"]
    assert row["seconds_without_compilation"] == pytest.approx(row["seconds"] - apart)
    assert set(row["psnr"]) == {"rgb", "thermal"}
    assert all(5 < value < 40 for value in row["psnr"].values())
    assert [found["step"] for found in row["memory"]] == [1, 2, 3]


@pytest.mark.slow
def test_peers_that_cannot_run_are_named(report: dict[str, Any]) -> None:
    """On the CPU our own step is timed alone, and the report says so."""
    (name,) = report["peers"]["peers"]
    assert name == "thermosplat"
    assert report["peers"]["peers"][name]["steps_per_s"] > 0
    assert "CUDA" in report["peers"]["left_out"]["gsplat"]


@pytest.mark.slow
def test_steps_have_parts_with_floors(report: dict[str, Any]) -> None:
    """Parts add up to the profiled kernels, and each but the rest has a floor below its time."""
    for row in (*report["step"], *report["sizes"]):
        assert set(row["parts"]) >= PARTS
        assert sum(part["ms"] or 0 for part in row["parts"].values()) == pytest.approx(row["kernels_ms"])
        assert sum(part.get("floor_ms", 0) for part in row["parts"].values()) == pytest.approx(row["floor_ms"])
        for name, part in row["parts"].items():
            assert (part.get("floor_ms", 0) > 0) == (name != "rest")
        terms = {
            f"loss {term}" for term in ("rgb", "thermal", "features_rgb", "features_thermal", "thermal_smoothness")
        }
        assert set(row["alone"]) == terms | {"finite check", "densification bookkeeping"}
        assert all(part["forward_ms"] > 0 and part["times_floor"] > 0 for part in row["alone"].values())
    values = 48 * 36 * 3
    floors = {name: part["floor_ms"] for name, part in report["sizes"][0]["alone"].items()}
    assert floors["loss rgb"] == pytest.approx(1e3 * 20 * values / report["peaks"]["bytes_per_s"])
    assert floors["loss features_thermal"] == pytest.approx(floors["loss rgb"] / 3)
    assert floors["densification bookkeeping"] == pytest.approx(1e3 * 25 * 400 / report["peaks"]["bytes_per_s"])
    assert report["sizes"][0]["num_gaussians"] == 400
    assert report["memory"] is None
    assert report["errors"] == {}


@pytest.mark.slow
def test_tables_hold_what_was_measured(report: dict[str, Any]) -> None:
    """Every part that was measured is in the Markdown file."""
    for title in (
        "Whole runs",
        "Steps per second",
        "Where a step goes",
        "Parts alone",
        "random 400 48x36",
        "left",
        "µs",
    ):
        assert title in report["tables"] + report["stdout"]


def test_nothing_starts_after_the_time_limit(tmp_path: Path) -> None:
    """The report says what was left out."""
    from bench_training import main

    path = tmp_path / "report.json"
    assert main(["sample", "--device", "cpu", "--time-limit", "0", "--json", str(path)]) == 0
    written = json.loads(path.read_text())
    assert written["whole"] == [{"kind": "default", "seed": 42, "error": "not started: the time limit"}]
    assert written["stopped"] == ["peers", "step on the capture", "100,000 Gaussians at 640x480"]


def _plain_sh(degree: int, directions: Tensor, coefficients: Tensor) -> Tensor:
    """As ``gsplat.spherical_harmonics``."""
    basis = spherical_harmonics(normalize(directions, dim=-1), degree)
    return torch.einsum("nk,nkc->nc", basis, coefficients[:, : basis.shape[-1]])


@pytest.mark.parametrize(
    ("kind", "expected"), [("features", 2), ("two spectra of SH", 2), ("separate sets", 2), ("three opacities", 3)]
)
def test_adapter_renders_what_the_model_asks_for(kind: str, expected: int, tmp_path: Path) -> None:
    """With a rasterizer of gsplat's signature called twice, losses and gradients are those of the one traversal.

    A third opacity is a call of its own with either rasterizer.
    """
    from peers.gsplat_rgbt import gsplat_rasterization
    from peers.training_steps import agreement
    from training.frozen_training import frozen_trainer, synthetic_capture, synthetic_gaussians

    config = replace(load_config("3dgs" if kind == "separate sets" else "thermosplat"), device="cpu")
    config = replace(config, background=(0.2, 0.4, 0.6))
    if kind == "two spectra of SH":
        config = replace(config, model=replace(config.model, feature_dim=0))
    if kind == "three opacities":
        config = with_spectra(config, nir={"opacity": "own"})
    capture = synthetic_capture(40, 30, config.modelled)
    gaussians = synthetic_gaussians(200, 8, 3, config.modelled)
    ours, other = (frozen_trainer(config, capture, tmp_path / name, gaussians=gaussians) for name in ("a", "b"))
    calls: list[int] = []

    def counted(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        return rasterization(*arguments, **options)

    found = agreement(ours, other, lambda: gsplat_rasterization(counted, _plain_sh))
    assert len(calls) == expected
    assert found["largest"] < 1e-5
    assert max(found["gradients"].values()) < 1e-4


def test_peers_take_turns_on_the_same_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is timed beside gsplat on CUDA, here with our rasterizer under gsplat's name."""
    from peers.training_steps import (
        AGREEMENT,
        GSPLAT_RGB,
        OURS,
        OURS_3DGS,
        OURS_BY_LINE,
        OURS_RGB,
        TWICE,
        USER,
        compare_steps,
    )
    from training.frozen_training import synthetic_capture
    from training.warm_training import warm_training

    gsplat, strategy = ModuleType("gsplat"), ModuleType("gsplat.strategy")
    monkeypatch.setattr(gsplat, "rasterization", rasterization, raising=False)
    monkeypatch.setattr(gsplat, "spherical_harmonics", _plain_sh, raising=False)
    monkeypatch.setattr(strategy, "DefaultStrategy", object, raising=False)
    monkeypatch.setattr(strategy, "MCMCStrategy", object, raising=False)
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    monkeypatch.setitem(sys.modules, "gsplat.strategy", strategy)
    monkeypatch.setitem(sys.modules, "train_gsplat_peer", None)  # so that it goes when the test ends
    del sys.modules["train_gsplat_peer"]
    config, capture = replace(load_config("thermosplat"), device="cpu"), synthetic_capture(40, 30)
    checkpoint, refinements = warm_training(config, capture, 1, {})
    assert refinements is None
    as_cuda: Any = SimpleNamespace(type="cuda")
    found = compare_steps(config, capture, checkpoint, {}, as_cuda, window=1, rounds=2)
    assert list(found["peers"]) == [OURS, OURS_BY_LINE, TWICE, USER, GSPLAT_RGB, OURS_3DGS, OURS_RGB]
    assert found["left_out"] == {}
    assert found["num_gaussians"] == 100
    assert found["agreement"]["largest"] < AGREEMENT
    assert max(found["user_agreement"].values()) < 1e-5
    assert all(peer["repeats"] == 2 and peer["median_ms"] > 0 for peer in found["peers"].values())
    assert found["peers"][OURS]["times_ours"] == 1.0

    monkeypatch.setattr(gsplat, "spherical_harmonics", lambda *given: _plain_sh(*given) + 0.1)
    found = compare_steps(config, capture, checkpoint, {}, as_cuda, window=1, rounds=1)
    assert {TWICE, USER}.isdisjoint(found["peers"])
    assert "differ" in found["left_out"][TWICE]
    assert "differ" in found["left_out"][USER]


def test_refinements_are_timed_beside_usual_steps() -> None:
    """A warm-up with refinements says what one adds."""
    from training.frozen_training import synthetic_capture
    from training.warm_training import warm_training

    config = replace(load_config("thermosplat"), device="cpu")
    config = replace(config, densification=replace(config.densification, start_step=1, every=8))
    checkpoint, refinements = warm_training(config, synthetic_capture(40, 30), 24, {})
    assert checkpoint.step == 24
    assert refinements is not None
    assert (refinements["timed"], refinements["every"]) == (2, 8)
    assert refinements["ms_a_step"] == pytest.approx(refinements["refinement_ms"] / 8)


def test_frozen_steps_repeat_the_same_work(tmp_path: Path) -> None:
    """Steps leave Gaussians, their number and the decoders as they are."""
    from training.frozen_training import frozen_trainer, run_steps, synthetic_capture, synthetic_gaussians

    config = replace(load_config("thermosplat"), device="cpu")
    gaussians = synthetic_gaussians(150, 8, 3)
    trainer = frozen_trainer(config, synthetic_capture(32, 24), tmp_path / "run", gaussians=gaussians)
    before = {name: value.detach().clone() for name, value in trainer.model.named_parameters()}
    run_steps(trainer, 2)
    assert trainer.sh_degree == 3
    assert trainer.model.num_gaussians == 150
    assert all(torch.equal(before[name], value) for name, value in trainer.model.named_parameters())
    moments = trainer.state.optimizers["shared"]["shN"].state_dict()["state"][0]["exp_avg"]
    assert moments.abs().max() > 0


def test_every_kernel_of_the_step_has_a_part() -> None:
    """The names in warp_kernels/ are known; a stranger's kernel is the rest."""
    from training.step_parts import part_of

    names: list[str] = []
    for path in (REPOSITORY / "warp_kernels").rglob("*.py"):
        names += re.findall(r'name\s*=\s*f?"([a-z_]+)', path.read_text())
    names.append("tile_ranges_kernel")
    assert len(names) > 15
    assert {name for name in names if part_of(name) == "rest"} == set()
    assert part_of("image_loss_tiles_adjoint_float32_ab12_cuda_kernel_forward") == "image losses"
    assert part_of("blend_adjoint_11_8_float32_8x4_ab12_cuda_kernel_forward") == "blending adjoint"
    assert part_of("project_pinhole_quats_float32_ab12_cuda_kernel_forward") == "projection"
    assert part_of("strand_sums_16_float32_ab12_cuda_kernel_forward") == "projection adjoint"
    assert part_of("adam_update_ab12_cuda_kernel_forward") == "optimizer"
    assert part_of("void at::native::vectorized_elementwise_kernel<4, at::native::FillFunctor>") == "rest"


def test_memory_fit_finds_the_slopes() -> None:
    """Bytes that are linear in Gaussians and pixels are found again; too few sizes give nothing."""
    from training.sizes import memory_fit

    sizes = [(n, p) for n in (100_000, 300_000) for p in (640 * 480, 1280 * 1024)]
    rows: list[dict[str, Any]] = [
        {"num_gaussians": n, "pixels": p, "memory_mib": (1100 * n + 300 * p + 2**24) / 2**20} for n, p in sizes
    ]
    fit = memory_fit(rows)
    assert fit is not None
    assert (fit["bytes_a_gaussian"], fit["bytes_a_pixel"]) == (pytest.approx(1100), pytest.approx(300))
    assert fit["bytes_besides"] == pytest.approx(2**24)
    assert fit["worst_mib"] < 1e-3
    assert memory_fit(rows[:2]) is None


@pytest.mark.slow
def test_the_sample_is_trained_on_the_cpu(tmp_path: Path) -> None:
    """Its row says on how many cores, and whether kernels had to be compiled."""
    from bench_training import main

    path, table = tmp_path / "report.json", tmp_path / "report.md"
    words = ["sample", "--device", "cpu", "--parts", "sample", "--cores", "1", "--warm-cache", "--json", str(path)]
    flags = ["--", "--data-factor", "8", "--log-every", "1"]
    assert main([*words, "--markdown", str(table), *flags, "--max-steps", "2"]) == 0
    row = json.loads(path.read_text())["sample"]
    assert (row["cores"], row["cold"], row["steps"]) == (1, False, 2)
    assert min(row["psnr"].values()) > 5
    assert "on 1 cores, with the user's cache" in table.read_text()


def test_steps_start_from_a_run(tmp_path: Path) -> None:
    """With --run its Gaussians are taken, and a run of another model is refused."""
    from bench_training import main
    from thermosplat.datasets import load_capture
    from training.frozen_training import quiet_trainer, run_steps

    capture = load_capture("sample", data_factor=8)
    trainer = quiet_trainer(replace(load_config("demo"), device="cpu", data_factor=8), capture, tmp_path / "run")
    run_steps(trainer, 1)
    chosen = torch.arange(trainer.model.num_gaussians) >= 2000
    prune(trainer.model.gaussians("shared"), trainer.state.optimizers["shared"], chosen)
    trainer.state.strategies["shared"].forget(2000)
    trainer.save()
    path = tmp_path / "report.json"
    words = ["sample", "--device", "cpu", "--parts", "peers", "--window", "1", "--rounds", "1", "--json", str(path)]
    words += ["--run", str(tmp_path / "run"), "--", "--data-factor", "8"]
    trainer.run.write_config(trainer.config)
    assert main(words) == 0
    assert json.loads(path.read_text())["peers"]["num_gaussians"] == 2000
    assert main([*words, "--sh-degree", "3"]) == 1
    assert "sh_degree" in json.loads(path.read_text())["errors"]["peers"]
