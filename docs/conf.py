"""The documentation site: the repository's Markdown pages, and an API reference from the docstrings.

    pip install ".[docs]"
    sphinx-build --fail-on-warning --conf-dir docs . build/site       # then open build/site/index.html

The source folder is the repository itself, so that a link between docs/, benchmarks/ and the files beside them is the
same on the site, on a disk and on a code host. Nothing is fetched from the network.
"""

import fnmatch
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sphinx.application import Sphinx

import thermosplat

project = "thermosplat"
author = "The thermosplat developers"
copyright = "2026, The thermosplat developers"
release = thermosplat.__version__

root_doc = "docs/index"
include_patterns = ["docs/**.md", "benchmarks/**.md", "tests/fixtures/README.md", "CHANGELOG.md", "CONTRIBUTING.md"]
exclude_patterns = [".*", "build", "data", "dist", "results"]  # whatever lies in a working tree

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
smartquotes_action = "qD"  # quotes and dashes; [..., N, 3] stays as it is

html_theme = "furo"
html_title = f"thermosplat {release}"
html_copy_source = False
html_extra_path = ["site_root"]  # the site's first page leads to docs/index.html

SIDEBAR = {
    "Use": [
        "docs/capturing*",
        "docs/prepar*",
        "docs/flights",
        "docs/data-layouts",
        "docs/spectra",
        "docs/viewer",
        "docs/result-folder",
        "docs/exports",
        "docs/conventions",
        "docs/comparing-methods",
        "docs/budget",
        "docs/refining-cameras",
        "docs/scaling",
        "docs/several-devices",
        "docs/platforms",
        "docs/troubleshooting",
        "docs/security",
        "docs/results",
        "docs/accuracy",
    ],
    "Build on it": ["docs/migrating", "docs/cuda-graphs", "docs/warp", "docs/warp-tape", "docs/kernels"],
    "The method": ["docs/method", "docs/thermosplat-plus"],
    "Reference": ["docs/api/*"],
    "Contribute": [
        "CONTRIBUTING",
        "docs/contributing/*",
        "benchmarks/README",
        "benchmarks/peers/README",
        "benchmarks/rendered_captures/README",
        "benchmarks/records/README",
        "benchmarks/notes/README",
        "tests/fixtures/README",
        "CHANGELOG",
    ],
}
"""Patterns of the pages under each heading, in their order. Pages of docs/ that none names stand under "More"."""


def add_navigation(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the sidebar to the pages that own it: in the Markdown files themselves it would only be noise."""
    pages = sorted(app.env.found_docs - {page})
    if page == root_doc:
        named = {heading: _matching(pages, patterns) for heading, patterns in SIDEBAR.items()}
        known = {name for names in named.values() for name in names}
        named["More"] = [name for name in pages if name.startswith("docs/") and name not in known]
    elif page in ("benchmarks/records/README", "benchmarks/notes/README"):
        named = {"": _matching(pages, [page.replace("README", "*")])}
    else:
        return
    for heading, names in named.items():
        if names:
            options = ":hidden:\n" + (f":caption: {heading}\n" if heading else "")
            source[0] += "\n```{toctree}\n" + options + "\n" + "\n".join(f"/{name}" for name in names) + "\n```\n"


def _matching(pages: list[str], patterns: list[str]) -> list[str]:
    return [name for pattern in patterns for name in pages if fnmatch.fnmatchcase(name, pattern)]


def prepare_docstring(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Keep what is written that the parsers would take for something else.

    Outside of ``code``, the bars of |x| would be a substitution of reStructuredText, and the hyphens of a --flag a
    dash. What stands before the first colon of a field's docstring would be its type to napoleon, which only looks at
    the first line: that one says nothing.
    """
    for number, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [
            re.sub(r"(?<![\w-])--[a-z][\w.-]*\w", r"``\g<0>``", part.replace("|", "\\|")) for part in parts[::2]
        ]
        lines[number] = "``".join(parts)
    if what in ("attribute", "property"):
        lines.insert(0, "\\")


EXAMPLE = "example.html"
"""A scene of the sample, which the first page of docs/ leads to."""


def make_example(app: Sphinx, exception: Exception | None) -> None:
    """Train the sample and export it as a page of 1 MB, where the site has none yet: two minutes on two CPU cores."""
    page = Path(app.outdir) / EXAMPLE
    if exception is not None or app.builder.format != "html" or page.is_file():
        return
    with TemporaryDirectory() as folder:
        for words in (
            ("train", "sample", "--result-dir", folder, "--densification.max-gaussians", "10000", "--no-tensorboard"),
            ("export", folder, "--format", "html", "--fit-passes", "8"),
        ):
            subprocess.run([sys.executable, "-m", "thermosplat", *words], check=True, stdout=subprocess.DEVNULL)
        (made,) = Path(folder).rglob("scene.html")
        page.write_bytes(made.read_bytes())


def setup(app: Sphinx) -> None:
    """What Sphinx calls."""
    app.connect("build-finished", make_example)
    app.connect("source-read", add_navigation)
    app.connect("autodoc-process-docstring", prepare_docstring, priority=400)  # napoleon's is 500
