"""Commands in the documents: programs and flags exist."""

import dataclasses
import inspect
import re
from collections.abc import Iterator

import pytest

from repository_documents import NAMES, REPOSITORY, code_blocks, read, without_code_blocks
from thermosplat.cli.benchmark import BenchmarkArguments
from thermosplat.cli.evaluate import EvalArguments
from thermosplat.cli.exporting.arguments import ExportArguments
from thermosplat.cli.exporting.map import PIXELS_BY_DEFAULT
from thermosplat.cli.exporting.surface import VOXELS_BY_DEFAULT
from thermosplat.cli.preparing.cameras import CalibrateArguments, RegisterArguments, SfmArguments
from thermosplat.cli.preparing.files import CheckArguments, ImportArguments, PairArguments
from thermosplat.cli.render import RenderArguments
from thermosplat.cli.view import ViewArguments
from thermosplat.config import TrainConfig
from thermosplat.config.gone_settings import GONE
from thermosplat.export.splat_fit.fitted_splats import PASSES
from thermosplat.spectra import DEFAULT_SPECTRA, SpectrumConfig

FURTHER_SPECTRA = ("nir",)
"""Names of further spectra in the documents' examples."""


def _train_flags(group: type = TrainConfig, prefix: str = "--") -> Iterator[str]:
    for field in dataclasses.fields(group):
        name = prefix + field.name.replace("_", "-")
        yield name
        factory = field.default_factory
        if isinstance(factory, type) and dataclasses.is_dataclass(factory):
            yield from _train_flags(factory, f"{name}.")
        elif group is TrainConfig and field.name == "spectra":
            for spectrum in (*DEFAULT_SPECTRA, *FURTHER_SPECTRA):
                yield from _train_flags(SpectrumConfig, f"{name}.{spectrum}.")
                yield from _train_flags(SpectrumConfig, f"--{spectrum}.")
        elif field.type is bool:
            yield f"{prefix}no-{field.name.replace('_', '-')}"


def test_the_flags_of_the_migration_table_exist() -> None:
    """The last column of its table names flags of thermosplat-train."""
    table = read("docs/migrating.md").split("\n\n| ")[1].split("\n\n")[0]
    named = {flag for row in table.splitlines()[2:] for flag in re.findall(r"--[\w.-]+", row.split("|")[4])}
    assert len(named) > 10
    assert named <= set(_train_flags())


def test_the_dotted_flags_in_the_documents_exist() -> None:
    """Only thermosplat-train has groups of flags; wherever a document names one of a group, it has it. Records may name
    those that there were when they were made, which are told today."""
    known, then = set(_train_flags()), {f"--{name.replace('_', '-')}" for name in GONE}
    then |= {flag.replace("--spectra.*.", f"--{spectrum}.") for flag in then for spectrum in DEFAULT_SPECTRA}
    groups = "|".join({flag[2:].split(".")[0] for flag in known if "." in flag})
    guides = "docs/contributing/"  # which name what a reader is about to add
    for name in (name for name in NAMES if not name.startswith(guides)):
        for flag in re.findall(rf"--(?:{groups})\.[\w.-]*[\w-]", read(name)):
            told = flag in then and name.startswith("benchmarks/records/")
            assert flag in known or told, f"{name} names {flag}"


def _flags_of_programs() -> dict[str, set[str]]:
    """What every command and every benchmark accepts, by its name."""
    flags = {
        "thermosplat-train": {
            *_train_flags(),
            "--viewer",
            "--viewer-host",
            "--devices",
            "--debug",
            "--help",
            "--help-all",
        }
    }
    commands = {"eval": EvalArguments, "render": RenderArguments, "export": ExportArguments, "view": ViewArguments}
    for name, arguments in {**commands, "benchmark": BenchmarkArguments}.items():
        flags[f"thermosplat-{name}"] = {*_train_flags(arguments), "--help", *({"--set"} if name == "benchmark" else ())}
    steps = [ImportArguments, PairArguments, CalibrateArguments, SfmArguments, RegisterArguments, CheckArguments]
    flags["thermosplat-prepare"] = {"--help"}.union(*(_train_flags(arguments) for arguments in steps))
    for path in (REPOSITORY / "benchmarks").rglob("*.py"):
        flags[path.name] = set(re.findall(r'"(--[a-z-]+)"', path.read_text(encoding="utf-8")))
    return flags


@pytest.mark.parametrize("name", NAMES)
def test_the_flags_of_commands_in_the_documents_exist(name: str) -> None:
    """Every command line between backticks or in a block, with all its flags."""
    flags = _flags_of_programs()
    lines = [line for block in code_blocks(name) for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`([^`]+)`", without_code_blocks(name))
    for line in lines:
        for command in re.split(r"&&|#|\|", line):
            found = re.search(r"thermosplat-\w+|\b(?:bench_\w+|train_gsplat_peer)\.py", command)
            if found is not None and found[0] in flags:
                own = re.sub(r'"[^"]*"', "", command[found.end() :])  # quoted flags are settings of trainings
                own = own.split(" -- ")[0]  # what follows is for thermosplat-train
                asked = set(re.findall(r"(?<=[\s\[])--[a-z][a-z-]*(?![\w.-])", own))
                assert asked <= flags[found[0]], f"{name}: {line}"


def test_numbers_of_exports_are_those_of_the_program() -> None:
    """What the page and --help say of the fit, of points, voxels and pixels is what holds without a flag."""
    page, texts = " ".join(read("docs/exports.md").split()), " ".join(inspect.getsource(ExportArguments).split())
    assert f"None: {PASSES['cpu']} on a CPU, {PASSES['cuda']} on a GPU" in texts
    assert f"`--fit-passes {PASSES['cuda']}` is how long" in page
    assert re.search(rf"That is the default on a GPU. On a\s+CPU it is {PASSES['cpu']},", page)
    assert f"at most `--points {ExportArguments.points}`" in page
    assert f"None: 1/{VOXELS_BY_DEFAULT} of the scene's longest side" in texts
    assert PIXELS_BY_DEFAULT == 1000
    assert "a thousandth of the map's longer side" in texts


def test_continuous_integration_runs_the_readmes_test_command() -> None:
    """.ci/run has the last line of the README's first block, to the letter; the line before it trains on the sample."""
    train, test = code_blocks("README.md")[0].splitlines()[-2:]
    assert train == "pip install . && thermosplat-train sample"
    assert f"\n({test})" in (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
