"""What documents and sources point to is there."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from repository_documents import DOCUMENTS, NAMES, REPOSITORY, without_code_blocks

SOURCES = [
    path
    for room in ("src", "warp_kernels", "benchmarks", "configs", "tests", "docs")
    for path in (REPOSITORY / room).rglob("*")
    if path.suffix in (".py", ".yaml")
]
NEW_OR_OLD = ("docs/contributing/", "benchmarks/records/rasterizer-sanitizer.md", "CHANGELOG.md")
"""Documents that name files which do not exist yet, or no longer."""


@pytest.mark.parametrize("name", NAMES)
def test_links_within_the_repository_lead_somewhere(name: str) -> None:
    """Files exist, and headings that are linked to."""
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", without_code_blocks(name)):
        file, _, anchor = target.partition("#")
        linked = (REPOSITORY / name).parent / file if file else REPOSITORY / name
        assert linked.exists(), f"{name} links to {target}"
        if anchor:
            assert anchor in set(_anchors(linked)), f"{name} links to {target}"


def _anchors(path: Path) -> Iterator[str]:
    """The anchors that GitHub gives a document's headings."""
    for heading in re.findall(r"^#+ (.+)$", without_code_blocks(path.relative_to(REPOSITORY).as_posix()), re.MULTILINE):
        yield re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_every_document_can_be_reached_from_the_readme() -> None:
    """Links lead from the README to each document of docs/ and benchmarks/, over any number of others."""
    reached, waiting = set(), [REPOSITORY / "README.md"]
    while waiting:
        path = waiting.pop()
        if path in reached:
            continue
        reached.add(path)
        links = re.findall(r"\]\((?!https?:)([^)\s#]+\.md)", path.read_text(encoding="utf-8"))
        waiting += [(path.parent / link).resolve() for link in links]
    pages = {path for path in DOCUMENTS if "src" not in path.parts}
    assert pages <= reached, sorted(path.name for path in pages - reached)


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith(NEW_OR_OLD)])
def test_files_that_a_document_names_exist(name: str) -> None:
    """A module between backticks is in the repository, in the room that is named with it."""
    known = {f"/{path.relative_to(REPOSITORY).as_posix()}" for path in SOURCES}
    for file in re.findall(r"`([\w/]+/\w+\.py)`", without_code_blocks(name)):
        assert any(path.endswith(f"/{file}") for path in known), f"{name} names {file}"


def test_files_that_a_source_names_exist() -> None:
    """The same of docstrings and comments, which name a module with or without its room."""
    known = [f"/{path.relative_to(REPOSITORY).as_posix()}" for path in SOURCES]
    of_others = {"examples/simple_trainer.py", "panorama_sfm.py"}  # gsplat's and COLMAP's
    missing = {
        (path.name, file)
        for path in SOURCES
        if "tests" not in path.relative_to(REPOSITORY).parts
        for file in re.findall(r"(?<![\w./-])[\w-]+(?:/[\w-]+)*\.py\b", path.read_text(encoding="utf-8"))
        if file not in of_others and not any(name.endswith(f"/{file}") for name in known)
    }
    assert not missing


def test_documents_that_a_source_names_exist() -> None:
    """Comments and messages send a reader to pages that are there."""
    named = {
        (path, page)
        for path in SOURCES
        for page in re.findall(r"(?:docs|benchmarks)/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 10
    missing = {(path.name, page) for path, page in named if not (REPOSITORY / page).is_file()}
    assert not missing
