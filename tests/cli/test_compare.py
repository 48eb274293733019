"""What thermosplat-compare makes of a folder that is no run."""

import subprocess
from pathlib import Path

import pytest

from thermosplat.cli.compare import CompareArguments, run_of


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ((), ["prepare june --out out/captures/june", "train out/captures/june like --result-dir out/runs/june"]),
        (("june/sparse/0/cameras.bin",), ["train june like --result-dir out/runs/june"]),
        (("june/transforms.json", "out/runs/june/ckpts/step_000100.pt"), ["train --resume out/runs/june --data june"]),
        (("out/runs/june/metrics.json",), []),
    ],
)
def test_a_folder_is_prepared_and_trained_as_the_first_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: tuple[str, ...], expected: list[str]
) -> None:
    """Untouched files, a capture, a training that was stopped, and one that is done."""
    for name in ("march/config.yaml", "june/photograph.jpg", *files):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    done: list[str] = []

    def run(command: list[str], *, check: bool) -> subprocess.CompletedProcess[bytes]:
        done.append(" ".join(command[4:]))
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", run)
    march, june = str(tmp_path / "march"), str(tmp_path / "june")
    arguments = CompareArguments(runs=(march, june))
    assert run_of(march, arguments, tmp_path / "out") == march
    assert run_of(june, arguments, tmp_path / "out") == str(tmp_path / "out" / "runs" / "june")
    like = f"--config {tmp_path}/march/config.yaml --device auto --overwrite"
    assert [line.replace(like, "like").replace(f"{tmp_path}/", "") for line in done] == expected


def test_a_step_that_fails_ends_the_comparison(tmp_path: Path) -> None:
    """With its own exit code: an empty folder has no files to prepare a capture of."""
    march, june = tmp_path / "march", tmp_path / "june"
    for folder in (march, june):
        folder.mkdir()
    with pytest.raises(SystemExit) as stop:
        run_of(str(june), CompareArguments(runs=(str(march), str(june))), tmp_path / "out")
    assert stop.value.code == 2
