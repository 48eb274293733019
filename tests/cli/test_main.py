"""The commands as modules: python -m thermosplat train, and python -m thermosplat.cli.train."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import thermosplat
from thermosplat.__main__ import COMMANDS, main
from training_processes import environment

pytestmark = pytest.mark.rotating

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


PLANTED = (
    "ast concurrent csv dataclasses errno inspect json omegaconf pathlib rich shlex signal tempfile typing tyro yaml"
)
"""Modules that the commands import, by names that a stranger's folder may hold, too."""


def run_module(*words: str, folder: Path | None = None, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a module in a folder, with further environment variables."""
    variables = environment() | variables
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=variables)


@pytest.fixture
def strange(tmp_path: Path) -> Path:
    """A folder with planted modules, each of which would end the command."""
    for name in PLANTED.split():
        (tmp_path / f"{name}.py").write_text("raise SystemExit(99)")
    return tmp_path


def test_every_script_is_a_command() -> None:
    """The table has the installed scripts, and leads to the same functions."""
    scripts = {name.removeprefix("thermosplat-"): target for name, target in PROJECT["scripts"].items()}
    assert scripts.pop("thermosplat") == "thermosplat.__main__:main"
    assert {name: f"{module}:main" for name, module in COMMANDS.items()} == scripts


@pytest.mark.rotating("commands in processes")
@pytest.mark.parametrize("name", COMMANDS)
def test_both_ways_run_the_command(name: str, strange: Path) -> None:
    """The version is printed by the command itself, whatever Python files lie in the current folder."""
    for words in (("thermosplat", name), (COMMANDS[name],)):
        assert run_module(*words, "--version", folder=strange).stdout.startswith("thermosplat ")


@pytest.mark.rotating("commands in processes")
@pytest.mark.parametrize("module", ["uses_thermosplat", "thermosplats"])
def test_other_programs_keep_the_current_folder(module: str, tmp_path: Path) -> None:
    """Those that import thermosplat, whatever they are called."""
    (tmp_path / f"{module}.py").write_text("import sys, thermosplat; print(sys.path[0])")
    assert run_module(module, folder=tmp_path).stdout == f"{tmp_path}\n"


@pytest.mark.rotating("commands in processes")
@pytest.mark.parametrize(("safe", "named", "code"), [("1", False, 0), ("", True, 99), ("1", True, 99)])
def test_what_the_environment_names_is_kept(safe: str, named: bool, code: int, strange: Path) -> None:
    """The folders of PYTHONPATH, where Python puts the current folder before them and where it does not."""
    path = os.pathsep.join([*([str(strange)] if named else []), environment()["PYTHONPATH"]])
    words = ("thermosplat", "train", "--version")
    assert run_module(*words, folder=strange, PYTHONPATH=path, PYTHONSAFEPATH=safe).returncode == code


@pytest.mark.rotating("commands in processes")
def test_mistakes_end_with_2() -> None:
    """A command's own mistake, an unknown command and none at all."""
    wrong = run_module("thermosplat", "train", "/nowhere")
    assert wrong.returncode == 2
    assert "/nowhere does not exist" in " ".join(wrong.stderr.split()) + " ".join(wrong.stdout.split())
    unknown, none = run_module("thermosplat", "fly"), run_module("thermosplat")
    assert unknown.returncode == none.returncode == 2
    assert "no command 'fly'" in unknown.stderr
    assert "prepare|train|eval" in none.stderr


def test_help_lists_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    """--help without a command; --version, too, needs none."""
    assert main(["--help"]) == 0
    commands = "prepare|train|eval|render|view|export|measure|report|compare|benchmark"
    assert f"thermosplat {commands}" in capsys.readouterr().out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"thermosplat {thermosplat.__version__}\n"
