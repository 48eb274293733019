"""Who comes from another trainer is told the flag here."""

from pathlib import Path
from typing import Any

import pytest

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.foreign_flags import refuse_foreign_flags, without_gone_flags
from thermosplat.config.gone_settings import GONE
from thermosplat.errors import UserError

MIGRATING = Path(__file__).parents[2] / "docs" / "migrating.md"


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["--data", "data/shed"], "thermosplat-train data/shed"),
        (["-s", "data/shed"], "thermosplat-train data/shed"),
        (["--data_dir=data/shed"], "thermosplat-train data/shed"),
        (["--source-path"], "thermosplat-train FOLDER"),
        (["data/shed", "--iterations", "3"], "--max-steps"),
        (["data/shed", "--max-num-iterations", "3"], "--max-steps"),
        (["data/shed", "-m", "out"], "--result-dir"),
        (["data/shed", "--lambda_dssim", "0.2"], "--loss.ssim-lambda"),
        (["data/shed", "--antialiasing"], GONE["model.rasterize_mode"].why),
    ],
)
def test_flags_of_other_trainers(words: list[str], hint: str) -> None:
    """The message names the flag that was given, the hint ours."""
    given = next(word for word in words if word.startswith("-")).partition("=")[0]
    with pytest.raises(UserError, match=f"has no flag {given}") as caught:
        parse_train_arguments(words)
    assert hint in caught.value.hint


def refused(words: list[str]) -> None:
    refuse_foreign_flags(words)
    without_gone_flags(words)


def test_every_flag_of_the_migration_table_has_a_hint() -> None:
    """What the table calls otherwise than thermosplat-train does is known, and led to what the table says."""
    rows = [
        line.split("|")[1:-1] for line in MIGRATING.read_text(encoding="utf-8").splitlines() if line.startswith("| `-")
    ]
    assert len(rows) > 10
    for row in rows:
        ours = [word.replace("DATA", "thermosplat-train x") for word in row[-1].split("`")[1::2]]
        for cell in row[:-1]:
            for flag in (part.split("`")[0] for part in cell.split("`")[1::2]):
                if flag.replace("_", "-") in row[-1] or flag == "--eval-mode interval":
                    continue
                with pytest.raises(UserError) as caught:
                    refused([flag, "x"])
                said = f"{caught.value.message} {caught.value.hint}"
                assert any(word in said for word in ours or [row[-1].strip()]), flag


def flags_of(name: str, value: Any) -> list[list[str]]:
    """Ways to give a setting on the command line."""
    flag = f"--{name.replace('*', 'thermal').removeprefix('spectra.').replace('_', '-')}"
    if isinstance(value, bool):
        group, dot, key = flag.removeprefix("--").rpartition(".")
        return [[flag if value else f"--{group}{dot}no-{key}"]]
    return [[flag, str(value)], [f"{flag.replace('-', '_').replace('__', '--', 1)}={value}"]]


@pytest.mark.parametrize("name", GONE)
def test_flags_of_settings_that_are_gone(name: str) -> None:
    """Those that ask for what is done today are left out, others refused with a sentence."""
    neutral = GONE[name].neutral
    for value in neutral:
        for words in flags_of(name, value):
            assert without_gone_flags(["data/shed", *words, "--seed", "3"]) == ["data/shed", "--seed", "3"]
    other = not neutral[0] if isinstance(neutral[0], bool) else "7.5"
    for words in flags_of(name, other):
        with pytest.raises(UserError, match=f"{words[0].partition('=')[0]} is no setting any more, found") as caught:
            parse_train_arguments(["data/shed", *words])
        assert caught.value.hint == "Leave it out."


def test_our_own_flags_pass() -> None:
    """Also those that another trainer has by the same name, and those of version 0.1 that kept theirs."""
    refuse_foreign_flags(["data/shed", "--max-steps", "3", "--sh_degree", "2", "--test-every", "8", "--resume", "x"])
    refuse_foreign_flags(["data/shed", "--thermal.source", "raw", "--thermal.unit", "celsius", "--thermal.aligned"])
    words = ["data/shed", "--thermal.source", "raw", "--no-graph", "--decoder.no-modulation", "--refine=rig", "-h"]
    assert without_gone_flags(words) == words
