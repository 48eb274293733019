"""Fixtures of the tests of the commands: running one, and a finished run on the sample capture."""

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sample_runs import QUICK, STEPS, Outcome, Run
from thermosplat.cli import train


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command; returns its exit code and what it printed, panels unfolded into running text."""

    def runner(main: Callable[[list[str]], int], *words: object) -> Outcome:
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as stop:
            code = int(stop.code or 0)
        captured = capsys.readouterr()
        printed = captured.out + captured.err
        assert "Traceback" not in printed
        return code, " ".join(re.sub("[│╭╮╰╯─]", " ", printed).split())

    return runner


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a few steps on the sample capture."""
    folder = tmp_path_factory.mktemp("runs") / "finished run"
    assert train.main(["sample", *QUICK, "--max-steps", str(STEPS), "--result-dir", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def finished(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of it, to which the tests of a module may add."""
    folder = tmp_path_factory.mktemp("runs") / "finished run"
    return shutil.copytree(trained, folder)


@pytest.fixture
def unharmed(finished: Path) -> Iterator[None]:
    """Nothing in the finished run changes during the test."""
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    yield
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before
