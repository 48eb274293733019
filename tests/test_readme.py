"""What the documents say is so: examples run, links lead somewhere, flags and presets exist."""

import dataclasses
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from thermosplat.cli import train
from thermosplat.cli.benchmark import BenchmarkArguments
from thermosplat.cli.evaluate import EvalArguments
from thermosplat.cli.export import ExportArguments
from thermosplat.cli.render import RenderArguments
from thermosplat.config import TrainConfig
from thermosplat.config_files import list_presets

REPOSITORY = Path(__file__).resolve().parents[1]
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")
DOCUMENTS = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").glob("*.md"), *REPOSITORY.glob("benchmarks/*.md")])


def python_examples() -> list[tuple[str, str]]:
    """Every Python block of the documents, with the document's name."""
    return [
        (path.name, code)
        for path in DOCUMENTS
        for code in re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
    ]


def _standalone(examples: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Those that need no trained scene."""
    return [(name, code) for name, code in examples if "load_run(" not in code]


@pytest.mark.parametrize(
    ("document", "code"),
    _standalone(python_examples()),
    ids=[name for name, _ in _standalone(python_examples())],
)
def test_the_examples_run(document: str, code: str) -> None:
    """An example runs as it stands, in a process of its own."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{document}: {done.stderr}"


def test_the_readme_has_the_example_of_the_renderer() -> None:
    """Ten lines that give an image and a gradient."""
    (example,) = [code for name, code in _standalone(python_examples()) if name == "README.md"]
    names: dict[str, object] = {}
    exec(example, names)
    assert names["image"].shape == (1, 240, 320, 3)  # type: ignore[attr-defined]
    assert names["means"].grad.abs().sum() > 0  # type: ignore[attr-defined]


def test_the_readme_has_the_example_of_a_trained_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the result folder of `thermosplat-train sample` to images of both spectra; here after one small step."""
    (example,) = [code for name, code in python_examples() if name == "README.md" and "load_run(" in code]
    monkeypatch.chdir(tmp_path)
    quick = ["--data-factor", "4", "--max-steps", "1", "--device", "cpu", "--no-tensorboard"]
    assert train.main(["sample", *quick]) == 0  # its default folder is the one the example names
    names: dict[str, object] = {}
    exec(example, names)
    for image in (names["rgb"], names["thermal"]):
        assert image.shape == (38, 50, 3)  # type: ignore[attr-defined]
        assert image.isfinite().all()  # type: ignore[attr-defined]
        assert not image.requires_grad  # type: ignore[attr-defined]


@pytest.mark.parametrize("path", DOCUMENTS, ids=[path.name for path in DOCUMENTS])
def test_links_within_the_repository_lead_somewhere(path: Path) -> None:
    """Files exist, and headings that are linked to."""
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", path.read_text(encoding="utf-8")):
        file, _, anchor = target.partition("#")
        linked = path.parent / file if file else path
        assert linked.exists(), f"{path.name} links to {target}"
        if anchor:
            assert anchor in set(_anchors(linked)), f"{path.name} links to {target}"


def _anchors(path: Path) -> Iterator[str]:
    """The anchors that GitHub gives a document's headings."""
    for heading in re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE):
        yield re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _train_flags(group: type = TrainConfig, prefix: str = "--") -> Iterator[str]:
    for field in dataclasses.fields(group):
        name = prefix + field.name.replace("_", "-")
        yield name
        factory = field.default_factory
        if isinstance(factory, type) and dataclasses.is_dataclass(factory):
            yield from _train_flags(factory, f"{name}.")
        elif field.type is bool:
            yield f"{prefix}no-{field.name.replace('_', '-')}"


def test_the_flags_of_the_migration_table_exist() -> None:
    """The last column of "Coming from" names flags of thermosplat-train."""
    table = README.split("## Coming from")[1].split("\n\n")[1]
    named = {flag for row in table.splitlines()[2:] for flag in re.findall(r"--[\w.-]+", row.split("|")[4])}
    assert len(named) > 10
    assert named <= set(_train_flags())


def test_the_dotted_flags_in_the_documents_exist() -> None:
    """Only thermosplat-train has groups of flags; wherever a document names one of a group, it has it."""
    known = set(_train_flags())
    groups = "|".join({flag[2:].split(".")[0] for flag in known if "." in flag})
    for path in DOCUMENTS:
        for flag in re.findall(rf"--(?:{groups})\.[\w-]+", path.read_text(encoding="utf-8")):
            assert flag in known, f"{path.name} names {flag}"


def _flags_of_programs() -> dict[str, set[str]]:
    """What every command and every benchmark accepts, by its name."""
    flags = {"thermosplat-train": {*_train_flags(), "--debug", "--help"}}
    commands = {"eval": EvalArguments, "render": RenderArguments, "export": ExportArguments}
    for name, arguments in {**commands, "benchmark": BenchmarkArguments}.items():
        flags[f"thermosplat-{name}"] = {*_train_flags(arguments), "--help", *({"--set"} if name == "benchmark" else ())}
    for path in (REPOSITORY / "benchmarks").glob("*.py"):
        flags[f"benchmarks/{path.name}"] = set(re.findall(r'"(--[a-z-]+)"', path.read_text(encoding="utf-8")))
    return flags


@pytest.mark.parametrize("path", DOCUMENTS, ids=[path.name for path in DOCUMENTS])
def test_the_flags_of_commands_in_the_documents_exist(path: Path) -> None:
    """Every command line between backticks or in a block, with all its flags."""
    flags = _flags_of_programs()
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()] + re.findall(r"^    (.+)$", text, re.MULTILINE)
    lines += re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    for line in lines:
        for command in re.split(r"&&|#|\|", line):
            found = re.search(r"thermosplat-\w+|benchmarks/\w+\.py", command)
            if found is not None and found[0] in flags:
                own = command[found.end() :].split(" -- ")[0]  # what follows is for thermosplat-train
                asked = set(re.findall(r"(?<=[\s\[])--[a-z][a-z-]*(?![\w.-])", own))
                assert asked <= flags[found[0]], f"{path.name}: {line}"


def test_the_readme_names_the_presets() -> None:
    """The presets the README offers exist."""
    offered = re.findall(r"`(\w+)` \(", README.split("`--config` names")[1].split("an ablation")[0])
    assert len(offered) == 4
    assert set(offered) <= set(list_presets())


def test_continuous_integration_runs_the_readmes_test_command() -> None:
    """.ci/run has the second line of the README's first block, to the letter."""
    block = README.split("```")[1].strip().splitlines()
    assert block[0].startswith("pip install . && thermosplat-train sample")
    assert f"\n({block[1]})" in (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
