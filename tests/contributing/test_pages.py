"""Pages that say how something is added: who does what they say, in a copy of the project, has it."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "contributing"
MOST_FILES = {"loss": 3, "decoder": 4, "spectrum-with-physics": 4, "camera-model": 6}
"""Of the project, a test among them, of which ``examples`` has the page's."""
_BLOCK = re.compile(r"```(py|diff)\n(.*?)```", re.DOTALL)
_FILE = re.compile(r"^`((?:src|warp_kernels)/[\w/]+\.py)`", re.MULTILINE)


def edited(page: str) -> dict[str, str]:
    """The files that a page touches, by path, as they are afterwards: a block is about the last file before it."""
    text, files = (PAGES / f"add-a-{page}.md").read_text(), {}
    for block in _BLOCK.finditer(text):
        path = _FILE.findall(text, 0, block.start())[-1]
        if block[1] == "py":
            assert not (ROOT / path).exists(), f"{path} is new, says the page of {page}s, and it is there."
            files[path] = block[2]
            continue
        files.setdefault(path, (ROOT / path).read_text())
        for hunk in block[2].split("@@\n"):
            lines = hunk.splitlines()
            before, after = ("\n".join(line[1:] for line in lines if line[0] in f" {sign}") for sign in "-+")
            count = files[path].count(before)
            assert count == 1, f"{path} has this {count} times:\n{before}"
            files[path] = files[path].replace(before, after)
    return files


def example(page: str) -> Path:
    """Tests of what the page adds."""
    return Path(__file__).parent / "examples" / f"add_a_{page.replace('-', '_')}.py"


@pytest.mark.parametrize(("page", "most"), MOST_FILES.items())
def test_a_page_touches_few_files(page: str, most: int) -> None:
    """What it replaces is there once, what is left is Python, and it names its test."""
    files = edited(page)
    assert len(files) + 1 <= most
    assert example(page).relative_to(ROOT).as_posix() in (PAGES / f"add-a-{page}.md").read_text()
    for path, text in files.items():
        ast.parse(text, path)


@pytest.mark.slow
@pytest.mark.parametrize("page", MOST_FILES)
def test_who_follows_a_page_has_it(page: str, tmp_path: Path) -> None:
    """In a copy of the project its example's tests, which train with what was added, pass, and its lines are tidy."""
    files = edited(page)
    for folder in ("src", "warp_kernels", "tests/fixtures"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "tests/conftest.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    shutil.copy(example(page), tmp_path / "tests" / "test_example.py")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (tmp_path / "src", tmp_path)))}
    for command in (
        ["pytest", "-q", "-p", "no:cacheprovider", "tests/test_example.py"],
        ["ruff", "check", "--ignore", "D1", *files],
    ):
        done = subprocess.run(
            [sys.executable, "-m", *command], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr
