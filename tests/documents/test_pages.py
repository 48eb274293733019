"""Documents have a size that a reader can take in."""

import re

import pytest

from repository_documents import NAMES, read, without_code_blocks
from thermosplat.config.files import preset_paths

LONGEST_LINE = 120


@pytest.mark.parametrize("name", NAMES)
def test_no_line_is_too_long(name: str) -> None:
    """At most 120 characters, outside of tables and code."""
    for number, line in enumerate(without_code_blocks(name).splitlines(), start=1):
        is_table_or_code = line.startswith(("|", "    "))
        assert is_table_or_code or len(line) <= LONGEST_LINE, f"{name}, line {number}: {len(line)} characters"


@pytest.mark.parametrize(("name", "lines"), [("README.md", 130), ("docs/results.md", 120)])
def test_what_everybody_reads_is_short(name: str, lines: int) -> None:
    """Raw tables and details have pages of their own."""
    assert read(name).count("\n") <= lines


def test_the_documents_can_be_read_in_an_afternoon() -> None:
    """docs, records and notes together; what is replaced is in git's history."""
    words = sum(len(read(name).split()) for name in NAMES if name.startswith(("docs/", "benchmarks/")))
    assert words <= 70_000


def test_the_readme_names_the_presets() -> None:
    """The presets the README offers exist."""
    offered = re.findall(r"`(\w+)`\s+\(", read("README.md").split("The presets:")[1].split("ablations")[0])
    assert len(offered) == 5
    assert set(offered) <= set(preset_paths())


@pytest.mark.parametrize("name", NAMES)
def test_configurations_in_commands_exist(name: str) -> None:
    """What follows `--config` is a preset, a file or a placeholder in capitals."""
    for config in re.findall(r"--config ([\w./]+)", read(name)):
        assert config in preset_paths() or config.isupper() or "/" in config or "." in config, f"{name}: {config}"


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("benchmarks/records/")])
def test_records_have_a_date_and_a_machine(name: str) -> None:
    """A number without them says nothing."""
    text = read(name)
    if not name.endswith("README.md"):
        assert re.search(r"2026-\d\d-\d\d", text), name
        assert re.search(r"H200|CPU", text), name
