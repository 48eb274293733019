"""The low-light benchmark says where runs ended, where they were best, and what fixed choices reach."""

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest

from bench_low_light import LIGHT, Cell, Row, cells, main, parse, read_run, table
from thermosplat.runs.run_directory import RunDirectory

ROW = Row(
    capture="desk",
    light="30",
    setting="thermosplat_plus",
    seed=42,
    in_grid=False,
    final={"rgb": 18.0, "thermal": 26.0},
    best={"rgb": 18.5, "thermal": 26.0},
    best_steps={"rgb": 1000, "thermal": 3000},
    num_gaussians=5000,
    model_bytes=1_500_000,
    on_copies={},
)


def test_best_is_that_of_each_spectrum(tmp_path: Path) -> None:
    """The highest evaluation of a run, and its step; the last one counts too."""
    run = RunDirectory.create(tmp_path / "run")
    for step, rgb, thermal in ((1000, 18.5, 24.0), (2000, 18.2, 25.0)):
        run.write_json(run.stats / f"step_{step:06d}.json", evaluation(rgb, thermal))
    run.write_json(
        run.metrics_json, evaluation(18.0, 26.0) | {"steps": 3000, "num_gaussians": 5000, "model_bytes": 1_500_000}
    )
    assert read_run(Cell("desk", "30", "thermosplat_plus", 42), run, {}) == ROW


def test_table_has_the_best_of_the_grid_and_the_model_of_the_light() -> None:
    """Fixed choices are no rows of their own; their best stands beside what the settings reached."""
    grid = [replace(ROW, in_grid=True, final={"rgb": rgb, "thermal": 25.0}) for rgb in (17.0, 18.75)]
    light = replace(ROW, light=LIGHT, on_copies={"30": {"rgb": 19.0, "thermal": 27.0}})
    text = table([ROW, *grid, light], {"desk": {"30": {"rgb": 19.9}}})
    assert "desk, 30 electrons at white; only noise is left at RGB 19.90 dB" in text
    assert (
        "| thermosplat_plus | 42 | 18.00 | 18.50 (1,000) | 18.75 | 26.00 | 26.00 (3,000) | 25.00 | 5,000 | 1.5 |"
        in text
    )
    assert "on these held-out views: thermosplat_plus, 42: 19.00 / 27.00" in text


def test_a_grid_is_trained_on_the_copies_alone() -> None:
    """Every choice of steps, of all schedules alike, and Gaussians; the settings on the capture as it is come first."""
    words = ["desk", "--electrons", "30", "--settings", "thermosplat", "--grid", "thermosplat_plus"]
    options, flags = parse([*words, "--grid-steps", "9", "2250", "--grid-gaussians", "9", "--", "--data-factor", "2"])
    assert flags == ["--data-factor", "2"]
    found = list(cells(options))
    assert [(cell.light, cell.in_grid) for cell in found] == [(LIGHT, False), ("30", False), ("30", True), ("30", True)]
    assert found[-1].setting == "thermosplat_plus --budget fixed --steps-scaler 0.375 --densification.max-gaussians 9"


def test_a_grid_is_trained_on_captures_as_they_are_where_there_are_no_copies() -> None:
    """As of arco, whose own light is what its grid is asked for."""
    words = ["arco", "--settings", "thermosplat", "--grid", "thermosplat_plus", "--grid-steps", "9000"]
    options, _ = parse([*words, "--grid-gaussians", "9", "--electrons"])
    assert [(cell.light, cell.in_grid) for cell in cells(options)] == [(LIGHT, False), (LIGHT, True)]


def test_captures_as_they_are_may_be_left_out() -> None:
    """Then the copies alone are trained on."""
    options, _ = parse(["desk", "--electrons", "30", "140", "--settings", "thermosplat", "--dark-only"])
    assert [cell.light for cell in cells(options)] == ["30", "140"]


@pytest.mark.slow
def test_benchmark_runs_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two trainings of the sample, one of them also evaluated on the other's held-out views; then nothing is left."""
    sample = str(files("thermosplat").joinpath("sample"))
    words = [sample, "--electrons", "140", "--settings", "demo", "--shrink", "4", "--every", "2", "--devices", "cpu"]
    words += ["--out", str(tmp_path), "--", "--max-steps", "4"]
    assert main(words) == 0
    light, dark = json.loads((tmp_path / "low_light.json").read_text())["rows"]
    assert (light["light"], dark["light"]) == (LIGHT, "140")
    assert set(light["on_copies"]) == {"140"}
    assert light["on_copies"]["140"]["thermal"] == pytest.approx(light["final"]["thermal"], abs=1e-3)
    assert dark["best"]["rgb"] >= dark["final"]["rgb"]
    assert "| demo | 42 |" in (tmp_path / "low_light.md").read_text()
    capsys.readouterr()
    assert main(words) == 0
    assert "| demo | 42 |" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "low_light.json").read_text())["rows"]) == 2


def evaluation(rgb: float, thermal: float) -> dict[str, object]:
    """What an evaluation writes, as far as it is read here."""
    return {"spectra": ["rgb", "thermal"], "rgb": {"psnr": rgb}, "thermal": {"psnr": thermal}}
