"""thermosplat-benchmark in this process; its cells run in processes of their own, as they always do."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from thermosplat.cli import benchmark

Run = Callable[..., tuple[int, str]]


def unfolded(printed: str) -> str:
    """Panels as running text."""
    return " ".join(re.sub("[│╭╮╰╯─]", " ", printed).split())


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command; returns its exit code and what it printed, panels unfolded into running text."""

    def runner(*words: object) -> tuple[int, str]:
        capsys.readouterr()
        try:
            code = benchmark.main([str(word) for word in words])
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        printed = captured.out + captured.err
        assert "Traceback" not in printed
        return code, unfolded(printed)

    return runner


@pytest.mark.slow
def test_matrix_is_made_once_and_merged(run: Run, tmp_path: Path) -> None:
    """A cell is trained in its process, then known; tables and sheets appear; another folder's cells can be added."""
    out = tmp_path / "matrix"
    words = ["sample", "--methods", "3dgs", "--max-steps", 3, "--data-factor", 4, "--devices", "cpu", "--out", out]
    code, printed = run(*words)
    assert code == 0, (out / "sample/3dgs/seed_42/cell.log").read_text()
    assert "sample / 3dgs / seed 42: finished" in printed
    assert "1 cell, 0 of them finished. Steps: 3dgs 3" in printed
    assert "| rgb | PSNR | 3dgs |" in printed
    expected = {"results.json", "per_view.csv", "tables.md", "table1.csv", "table1.tex", "cost.csv", "sheets", "sample"}
    assert expected <= {path.name for path in out.iterdir()}
    assert len(list((out / "sheets").glob("sample_*.png"))) == 3
    assert [cell["steps"] for cell in json.loads((out / "results.json").read_text())["cells"]] == [3]

    made = (out / "sample/3dgs/seed_42/cell.json").stat().st_mtime_ns
    code, printed = run(*words)
    assert code == 0
    assert "starts on" not in printed
    assert (out / "sample/3dgs/seed_42/cell.json").stat().st_mtime_ns == made

    code, printed = run("--out", tmp_path / "other", "--merge", out)
    assert code == 0
    assert "| rgb | PSNR | 3dgs |" in printed
    assert (tmp_path / "other" / "results.json").is_file()

    code, printed = run(*["4" if word == 3 else word for word in words])
    assert code == 2
    assert "max_steps=3, now 4" in printed


@pytest.mark.slow
def test_failed_cell_stops_no_other_and_time_runs_out(run: Run, tmp_path: Path) -> None:
    """A broken scene before a good one: the good one is made. With no time at all nothing is begun, nothing lost."""
    (tmp_path / "empty").mkdir()
    out = tmp_path / "matrix"
    words = [
        tmp_path / "empty",
        "sample",
        "--methods",
        "3dgs",
        "--max-steps",
        2,
        "--data-factor",
        4,
        "--set",
        "3dgs:sh_degree=1",
        "--out",
        out,
    ]
    code, printed = run(*words, "--devices", "cpu", "--time-limit", 0)
    assert code == 0
    assert "2 of 2 cells not begun" in printed
    assert not list(out.rglob("cell.log"))
    code, printed = run(*words, "--devices", "cpu")
    assert code == 2
    assert "1 of 2 cells failed." in printed
    assert "empty / 3dgs / seed 42: failed: " in printed
    assert "2 cells, 0 of them finished. Steps: 3dgs 2" in printed
    assert "sample / 3dgs / seed 42: finished (2 of 2)" in printed
    assert "| rgb | PSNR | 3dgs |" in printed
    (cell,) = json.loads((out / "results.json").read_text())["cells"]
    assert (cell["scene"], cell["settings"]["sh_degree"]) == ("sample", 1)
    code, printed = run(*words[1:], "--out", tmp_path / "third", "--merge", out)
    assert code == 0
    assert "starts on" not in printed  # what was merged is finished


@pytest.mark.slow
def test_failed_cell_is_named(run: Run, tmp_path: Path) -> None:
    """A cell that cannot be trained ends the command with code 2, its reason and its log; nothing else is lost."""
    (tmp_path / "empty").mkdir()
    out = tmp_path / "matrix"
    code, printed = run(tmp_path / "empty", "--methods", "3dgs", "--devices", "cpu", "--out", out)
    assert code == 2
    assert "empty / 3dgs / seed 42 (exit code 2" in printed
    assert "1 of 1 cell failed." in printed
    assert printed.count("no capture of a known layout") == 2  # when it failed, and at the end
    assert (out / "empty/3dgs/seed_42/cell.log").read_text().splitlines()[-1].startswith("Error: ")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--out", "nowhere/at/all"], "No scene given"),
        (["no/such/capture"], "no capture folder no/such/capture"),
        (["sample", "--methods", "mmon"], 'did you mean "mmone"'),
        (["sample", "--max-steps", "0"], "--max-steps must be at least 1"),
        (["sample", "--seeds", "1", "1"], "--seeds must be different"),
        (["sample", "--device", "cpu"], "--devices"),
        (["sample", "--gpus", "2", "--devices", "cpu"], "Give one of the two"),
        (["sample", "--methods", "mmone", "--set", "3dgs:sh_degree=1"], 'no cell of this matrix is called "3dgs"'),
        (["sample", "--methods", "mmone", "--set", "sh_degre=1"], 'did you mean "sh_degree"'),
        (["--merge", "no/such/results"], "no no/such/results to merge"),
        (["sample", "--out", __file__], "test_benchmark.py is a file; a matrix needs a folder"),
    ],
)
def test_mistakes_end_before_anything_is_trained(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], expected: str
) -> None:
    """Every mistake ends with code 2 and says what to do, before anything is trained."""
    monkeypatch.chdir(tmp_path)
    code, printed = run(*words)
    assert code == 2
    assert expected in printed
