"""bench_rasterization.py runs, on scenes far too small to measure anything, and writes what it found."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmark_scripts import run_script

STAGES = {"projection", "binning", "blending", "blending adjoint", "projection adjoint"}


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A report of two scenes and two cases, and the files it wrote."""
    folder = tmp_path_factory.mktemp("bench")
    options = ["--device", "cpu", "--scene", "synthetic", "huge", "--count", "700", "--sizes", "48x32"]
    options += ["--cases", "features11", "rgbt", "--repeats", "1", "--peers", "torch", "--cores", "1", "2"]
    files = ["--json", str(folder / "report.json"), "--markdown", str(folder / "report.md")]
    done = run_script("bench_rasterization.py", *options, *files)
    assert done.returncode == 0, done.stdout + done.stderr
    written = json.loads((folder / "report.json").read_text())
    return written | {"stdout": done.stdout, "markdown": (folder / "report.md").read_text()}


@pytest.mark.slow
def test_every_case_is_checked_and_timed(report: dict[str, Any]) -> None:
    """Each row has the times of both renderers, their errors, and the stages with their floors."""
    rows = report["rows"]
    assert [(row["scene"], row["case"]) for row in rows] == [
        (scene, case) for scene in ("synthetic 700", "huge 700") for case in ("features11", "rgbt")
    ]
    for row in rows:
        assert set(row["forward"]) == set(row["forward_backward"]) == {"thermosplat", "plain torch"}
        assert row["forward_backward"]["thermosplat"]["median_ms"] > 0
        assert row["forward_backward"]["thermosplat"]["host_ms"] > 0
        for error in row["error_to_float64"].values():
            assert error["image_mean"] <= error["image_rms"] <= error["image_max"] < 1e-3
        assert set(row["stages"]) == STAGES | ({"colors", "colors adjoint"} if row["case"] == "rgbt" else set())
        assert all(stage["floor_ms"] > 0 for stage in row["stages"].values())
        assert row["floor_ms"] == pytest.approx(sum(stage["floor_ms"] for stage in row["stages"].values()))
        assert 0 < row["fragments"]["drawn"] <= row["fragments"]["either"] <= row["fragments"]["listed"]
        assert set(row["cores"]) == {"1", "2"}
        assert row["intersections"]["thermosplat"] > 0


@pytest.mark.slow
def test_the_tables_hold_every_row(report: dict[str, Any]) -> None:
    """Summary, times, errors, stages and threads are in the Markdown file, and the summary on the terminal."""
    found = report["summaries"][0]
    assert found["peer"] == "plain torch"
    assert [entry["cases"] for entry in found["targets"]] == [2, 2, 2]
    for text in (
        "thermosplat against plain torch",
        "synthetic 700 48x32",
        "huge 700 48x32",
        "rgbt",
        "projection adjoint",
    ):
        assert text in report["markdown"]
    assert "geometric mean" in report["stdout"]


@pytest.mark.slow
def test_a_time_limit_keeps_what_was_measured(report: dict[str, Any], tmp_path: Path) -> None:
    """Nothing is started after the limit, and the report says where it stopped; what a resumed file holds stays."""
    path = tmp_path / "report.json"
    path.write_text(json.dumps({"rows": report["rows"][:2]}))
    options = ["--device", "cpu", "--peers", "--time-limit", "0", "--no-stages", "--json", str(path), "--resume"]
    done = run_script("bench_rasterization.py", *options, "--count", "700", "--sizes", "48x32", "16x16")
    assert done.returncode == 0, done.stdout + done.stderr
    written = json.loads(path.read_text())
    assert written["rows"] == report["rows"][:2]
    assert "synthetic 700 16x16 features11" in written["stopped"]


def test_a_wrong_path_is_a_row_and_a_failure(tmp_path: Path) -> None:
    """A scene that is not there is reported beside the others."""
    path = tmp_path / "report.json"
    options = ["--device", "cpu", "--peers", "--no-stages", "--scene", str(tmp_path / "gone.ply"), "--json", str(path)]
    done = run_script("bench_rasterization.py", *options)
    assert done.returncode == 1
    (row,) = json.loads(path.read_text())["rows"]
    assert "FileNotFoundError" in row["error"]


@pytest.mark.slow
def test_loops_whose_shapes_change(tmp_path: Path) -> None:
    """Each loop has a row with the time of a call and of the first call after a change, and a line in the table."""
    options = ["--device", "cpu", "--changing", "--scene", "synthetic", "--count", "60", "--sizes", "48x32", "32x32"]
    files = ["--json", str(tmp_path / "report.json"), "--markdown", str(tmp_path / "report.md")]
    done = run_script("bench_rasterization.py", *options, "--cases", "features11", "--peers", *files)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "report.json").read_text())["rows"]
    assert [row["loop"] for row in rows] == ["sizes take turns", "Gaussians become more"]
    for row in rows:
        times = row["changing"]["thermosplat"]
        assert times["ms_per_call"]["median_ms"] > 0
        assert times["first_ms"] > 0
        assert row["loop"] in (tmp_path / "report.md").read_text()
