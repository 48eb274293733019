"""What thermosplat-compare makes of a folder that is no run."""

from pathlib import Path

import pytest

from thermosplat.cli import compare
from thermosplat.cli.compare import CompareArguments


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
    monkeypatch.setattr(compare, "_do", lambda *words: done.append(" ".join(words)))
    march, june = str(tmp_path / "march"), str(tmp_path / "june")
    arguments = CompareArguments(runs=(march, june))
    assert compare._run_of(march, arguments, tmp_path / "out") == march
    assert compare._run_of(june, arguments, tmp_path / "out") == str(tmp_path / "out" / "runs" / "june")
    like = f"--config {tmp_path}/march/config.yaml --device auto --overwrite"
    assert [line.replace(like, "like").replace(f"{tmp_path}/", "") for line in done] == expected


def test_a_step_that_fails_ends_the_comparison() -> None:
    """With its own exit code."""
    with pytest.raises(SystemExit) as stop:
        compare._do("no such command")
    assert stop.value.code == 2
