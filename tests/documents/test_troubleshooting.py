"""docs/troubleshooting.md: the messages of its tables are those of the source."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = REPOSITORY / "docs" / "troubleshooting.md"
FILLED_IN = re.compile(r"[\w.,]*[\d/_](?:[\w./,]*\w)?")
"""Numbers and names of files in a message."""
LEAST_WORDS, LEAST_LETTERS = 3, 14
"""Of a message that stand together in the source."""
SECTIONS = re.findall(r"^## (.+)$", PAGE.read_text(), re.MULTILINE)
ASSEMBLED = {
    "... is 8-bit colour (a palette), not temperatures.",
    "... is damaged (Corrupt JPEG data: ...).",
    "3 of 20 cells failed: ...",
}
"""Messages that the source puts together of pieces of a word or two."""
NAMED = {"mae_celsius", 'info["num_nonfinite"]', "torchvision"}
"""What a row is about, where nothing is said."""


def messages(section: str) -> list[str]:
    """The messages of a section's table, without the backticks."""
    _, _, after = PAGE.read_text().partition(f"\n## {section}\n")
    rows = [line for line in after.partition("\n## ")[0].splitlines() if line.startswith("| `")]
    cells = [re.split(r"(?<!\\)\|", row)[1] for row in rows]
    return [message for cell in cells for message in re.findall(r"`([^`]+)`", cell)]


@cache
def said_by_the_source() -> str:
    """All texts of the package, with {} for what is filled in, and blanks between words made one."""
    texts = []
    for path in sorted((REPOSITORY / "src").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
                texts.append(" ".join("".join(map(str, parts)).split()))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(" ".join(node.value.split()))
    return "\n".join(texts)


def is_said(message: str) -> bool:
    """Whether some words of a message, one after the other, are words of the source."""
    words = [FILLED_IN.sub("{}", word) for word in message.replace("...", " ").lstrip("! ").split()]
    for start in range(len(words)):
        phrases = [" ".join(words[start:end]) for end in range(start + LEAST_WORDS, len(words) + 1)]
        shortest = next((phrase for phrase in phrases if len(phrase) >= LEAST_LETTERS), None)
        if shortest is not None and shortest in said_by_the_source():
            return True
    return False


@pytest.mark.parametrize("section", SECTIONS)
def test_the_messages_of_a_section_are_in_the_source(section: str) -> None:
    """Who looks for what a command said finds it in the tables, in the words in which it is said today."""
    known = ASSEMBLED | NAMED
    assert [message for message in messages(section) if message not in known and not is_said(message)] == []


def test_what_the_comparison_leaves_out_is_in_the_tables() -> None:
    """No exception outlives its row."""
    assert {message for section in SECTIONS for message in messages(section)} >= ASSEMBLED | NAMED


def test_another_message_is_not_found() -> None:
    """The comparison can fail: with words that nothing says, and with words in another order."""
    assert len(messages("Preparing a capture")) > 10
    assert not is_said("captures/shed holds seven purple elephants and a zebra")
    assert not is_said("cannot file the radiometric read damaged")
