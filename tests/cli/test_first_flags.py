"""``thermosplat-train --help`` has the flags that people use first, ``--help-all`` every one."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from thermosplat.cli.arguments import TrainArguments, parse_train_arguments
from thermosplat.cli.first_flags import FIRST, FIRST_OF_SPECTRA
from thermosplat.config.checks import flattened
from thermosplat.config.files import load_config

PAGE = Path(__file__).parents[2] / "docs/api/configuration.md"


def printed(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a command line prints that asks for help."""
    with pytest.raises(SystemExit) as stop:
        parse_train_arguments(words)
    assert stop.value.code == 0
    return capsys.readouterr().out


def flags_of(text: str) -> list[str]:
    """The flags that a help describes, but for that of the help."""
    return re.findall(r"^[│ ] (--[\w.-]+)", text, re.MULTILINE)


@pytest.mark.parametrize("words", [["--help"], ["-h", "--seed", "3"], ["x", "--help", "--loss.scale-reg", "0.1"]])
def test_help_has_the_first_flags(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """In their order, then those of each spectrum; it says how to see the others. Other flags may stand beside it."""
    text = printed(words, capsys)
    first = [f"--{name.replace('_', '-')}" for name in FIRST if name != "data"]
    assert flags_of(text) == [*first, *(f"--{name}.{flag}" for name in ("rgb", "thermal") for flag in FIRST_OF_SPECTRA)]
    assert len(flags_of(text)) <= 20
    assert "--help-all" in text
    assert "--seed INT" not in text


def test_first_flags_have_the_values_of_the_preset(capsys: pytest.CaptureFixture[str]) -> None:
    """As every flag has."""
    text = " ".join(printed(["--config", "demo", "--help"], capsys).replace("│", " ").split())
    assert f"(default: {load_config('demo').max_steps})" in text
    assert "Folder of the capture" in text


def test_all_flags_are_printed_where_they_are_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    """Every setting of the preset, and the command's own."""
    names = [name for name, _ in flattened(load_config("3dgs")) if name != "data"]
    names += [field.name for field in fields(TrainArguments) if field.name in ("viewer", "viewer_host", "devices")]
    described = flags_of(printed(["--config", "3dgs", "--help-all"], capsys))
    assert {f"--{name.replace('_', '-')}" for name in names} <= set(described)


def test_the_page_of_settings_begins_with_the_first() -> None:
    """The table before the list of all fields."""
    table = PAGE.read_text(encoding="utf-8").split("## All fields")[0]
    assert re.findall(r"^\| `([\w.*]+)` \|", table, re.MULTILINE) == [
        *(name for name in FIRST if name not in ("devices", "viewer")),
        *(f"spectra.*.{name}" for name in FIRST_OF_SPECTRA),
    ]
