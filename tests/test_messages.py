"""No message shows a piece of the program in the place of its value: every brace of a text is filled in."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
FIELD = re.compile(r"\{([^{}]+)\}")
TEMPLATES = ("TextColumn", ".format", ".format_map")
"""What fills in the braces of a text itself."""


def names_in(tree: ast.AST) -> set[str]:
    """All names that a file uses or makes."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.alias):
            found.add((node.asname or node.name).partition(".")[0])
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
    return found


def left_alone(tree: ast.AST) -> Iterator[ast.AST]:
    """Texts that may have braces: docstrings, and those that something else fills in."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr):
            yield node.value
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(TEMPLATES):
            yield from ast.walk(node)


def unfilled(source: str) -> list[str]:
    """Fields of texts that would be shown as they stand: expressions of names that the file has."""
    tree = ast.parse(source)
    names, apart = names_in(tree), {id(node) for node in left_alone(tree)}
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str) or id(node) in apart:
            continue
        for field in FIELD.findall(node.value):
            try:
                filled = ast.parse(f'f"""{{{field}}}"""', mode="eval")
            except SyntaxError:  # no expression
                continue
            used = {part.id for part in ast.walk(filled) if isinstance(part, ast.Name)}
            if used and used <= names:
                found.append(f"line {node.lineno}: {{{field}}}")
    return found


@pytest.mark.parametrize("folder", ["src", "warp_kernels"])
def test_every_brace_is_filled_in(folder: str) -> None:
    """In messages, notes and whatever else is a text."""
    files = sorted((REPOSITORY / folder).rglob("*.py"))
    assert len(files) > 20
    found = {str(path.relative_to(REPOSITORY)): unfilled(path.read_text(encoding="utf-8")) for path in files}
    assert {path: fields for path, fields in found.items() if fields} == {}


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("say = count = 1\nsay(f'{count} images. ' 'Better remove {say(count, 2)}.')", 1),
        ("count = 1\nsay('{count:,} images, {count!r}')", 2),
        ("count = 1\nsay(f'{count:,} images of {{count}}')", 1),
        ("count = 1\nsay(f'{count:,} images')", 0),
        ("count = 1\nsay('{count:,} images'.format(count=count))", 0),
        ("'''Docstring of {x}.'''\nx = '{margin: 0} [0-9]{6,} {}'", 0),
    ],
)
def test_the_lint_sees(source: str, count: int) -> None:
    """It can fail."""
    assert len(unfilled(source)) == count
