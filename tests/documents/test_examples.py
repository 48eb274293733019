"""Python in the documents: whole examples run, fragments of files can be parsed."""

import ast
import textwrap
from pathlib import Path

import pytest

from forked_processes import run_python
from repository_documents import NAMES, code_blocks
from thermosplat.cli import train

EXAMPLES = [(name, code) for name in NAMES for code in code_blocks(name, "python")]
STANDALONE = [(name, code) for name, code in EXAMPLES if "load_run(" not in code]  # those that need no trained scene
FRAGMENTS = [(name, code) for name in NAMES for code in code_blocks(name, "py")]


@pytest.mark.rotating
@pytest.mark.parametrize(("document", "code"), STANDALONE, ids=[name for name, _ in STANDALONE])
def test_the_examples_run(document: str, code: str, tmp_path: Path) -> None:
    """An example runs as it stands, in a process and a folder of its own."""
    script = tmp_path / "example.py"  # Warp reads the source of kernels
    script.write_text(code, encoding="utf-8")
    done = run_python(script, folder=tmp_path)
    assert done.returncode == 0, f"{document}: {done.stderr}"


@pytest.mark.parametrize(("document", "code"), FRAGMENTS, ids=[name for name, _ in FRAGMENTS])
def test_the_fragments_are_python(document: str, code: str) -> None:
    """A fragment of a file has no mistake of syntax."""
    ast.parse(textwrap.dedent(code), filename=document)


def test_the_readme_has_the_example_of_the_renderer() -> None:
    """Ten lines that give an image and a gradient."""
    (example,) = [code for name, code in STANDALONE if name == "README.md"]
    names: dict[str, object] = {}
    exec(example, names)
    assert names["image"].shape == (1, 240, 320, 3)  # type: ignore[attr-defined]
    assert names["means"].grad.abs().sum() > 0  # type: ignore[attr-defined]


@pytest.fixture
def trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """What the README's example knows of the result folder of `thermosplat-train sample`; after a small step."""
    (example,) = [code for name, code in EXAMPLES if name == "README.md" and "load_run(" in code]
    monkeypatch.chdir(tmp_path)
    quick = ["--data-factor", "4", "--max-steps", "1", "--device", "cpu", "--no-tensorboard"]
    assert train.main(["sample", *quick]) == 0  # its default folder is the one the example names
    names: dict[str, object] = {}
    exec(example, names)
    return names


def test_the_readme_has_the_example_of_a_trained_scene(trained: dict[str, object]) -> None:
    """Images, numbers and temperatures, also in the documents of the viewer and of trained scenes."""
    names = trained
    for image in (names["rgb"], names["thermal"]):
        assert image.shape == (38, 50, 3)  # type: ignore[attr-defined]
        assert image.isfinite().all()  # type: ignore[attr-defined]
        assert not image.requires_grad  # type: ignore[attr-defined]
    (viewing,) = [code for name, code in EXAMPLES if name == "docs/viewer.md" and "load_run(" in code]
    exec(viewing, names)
    assert names["image"].unit == "°C"  # type: ignore[attr-defined]
    assert names["numbers"].minimum < names["numbers"].maximum  # type: ignore[attr-defined]
    (measuring,) = [code for name, code in EXAMPLES if name == "docs/api/trained-scenes.md"]
    exec(measuring, names)
    assert names["celsius"].shape == names["depth"].shape == (38, 50)  # type: ignore[attr-defined]
    assert 0 < names["celsius"].mean() < 60  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_trained_scene_is_exported(trained: dict[str, object]) -> None:
    """Videos and files, as the document of exports writes them."""
    names = trained
    exports = [code for name, code in EXAMPLES if name == "docs/exports.md" and "load_run(" in code]
    for exporting in exports:
        exec(exporting, names)
    assert names["video"].stat().st_size > 0  # type: ignore[attr-defined]
    assert names["fit"].after >= names["fit"].before  # type: ignore[attr-defined]
    assert {file.path.suffix for file in names["files"]} == {".spz", ".sog", ".usd"}  # type: ignore[attr-defined]
