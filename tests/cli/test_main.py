"""The commands as modules: python -m thermosplat train, and python -m thermosplat.cli.train."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from thermosplat.__main__ import COMMANDS, main

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def run_module(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", *words], capture_output=True, text=True, check=False)


def test_every_script_is_a_command() -> None:
    """The table has the installed scripts, and leads to the same functions."""
    scripts = {name.removeprefix("thermosplat-"): target for name, target in PROJECT["scripts"].items()}
    assert {name: f"{module}:main" for name, module in COMMANDS.items()} == scripts


@pytest.mark.parametrize("name", COMMANDS)
def test_both_ways_run_the_command(name: str) -> None:
    """The version is printed by the command itself."""
    assert run_module("thermosplat", name, "--version").stdout.startswith("thermosplat ")
    assert run_module(COMMANDS[name], "--version").stdout.startswith("thermosplat ")


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
    """--help without a command."""
    assert main(["--help"]) == 0
    assert "prepare|train|eval|render|view|export|benchmark" in capsys.readouterr().out
