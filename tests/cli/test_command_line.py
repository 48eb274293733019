"""What all commands understand: --help that reads well, --version, an output that nobody reads, Ctrl-C at the start."""

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from thermosplat import __version__
from thermosplat.cli import benchmark, evaluate, export, prepare, render, train
from thermosplat.cli.command_line import check_ranges
from thermosplat.errors import UserError

pytestmark = [pytest.mark.usefixtures("stoppable"), pytest.mark.rotating]

COMMANDS = {
    "train": train,
    "evaluate": evaluate,
    "render": render,
    "export": export,
    "prepare": prepare,
    "benchmark": benchmark,
}

INTERRUPTED_IMPORT = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "pycolmap":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
from thermosplat.cli.{command} import main
code = main(["{folder}"])
print(code, hasattr(sys.modules.get("pycolmap"), "Reconstruction"))
"""


def in_a_process(script: str, **options: object) -> "subprocess.CompletedProcess[str]":
    """Run a script with the modules of this process, wherever they come from."""
    source = Path(__file__).parents[2] / "src"
    path = os.pathsep.join([str(source), str(source.parent), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run([sys.executable, "-c", script], env=environment, text=True, **options)  # type: ignore[call-overload]


@pytest.mark.parametrize("command", COMMANDS)
def test_version(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """--version says it and ends with code 0, whatever else is asked."""
    assert COMMANDS[command].main(["--version"]) == 0
    assert capsys.readouterr().out == f"thermosplat {__version__}\n"


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (None, None),
        (3.5, None),
        ((1, 9.0), None),
        (0, "must be at least 1, found 0."),
        (float("nan"), "must be at least 1, found nan."),
        (float("inf"), "must be at most 1,000, found inf."),
        ((2, 1e308), "must be at most 1,000, found 1e+308."),
        (10**400, "must be at most 1,000, found 1000"),
    ],
)
def test_numbers_have_ranges(value: object, message: str | None) -> None:
    """Of a flag that has one number, several or none; the message names flag, bound and value."""
    arguments = SimpleNamespace(of_these=value)
    if message is None:
        check_ranges(arguments, of_these=(1, 1000))
        return
    with pytest.raises(UserError, match=re.escape(f"--of-these {message}")):
        check_ranges(arguments, of_these=(1, 1000))


@pytest.mark.parametrize(("command", "examples"), [("train", 5), ("benchmark", 6)])
def test_help_has_the_examples(command: str, examples: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Each on its own line, as the docstring has them."""
    assert COMMANDS[command].main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert "Examples:\n" in printed
    assert len(re.findall(rf"^  thermosplat-{command} ", printed, re.MULTILINE)) == examples


def test_help_wraps_at_the_edge_alone(capsys: pytest.CaptureFixture[str]) -> None:
    """Where a description's line ends in the source cannot be seen."""
    assert train.main(["--help-all"]) == 0
    printed = capsys.readouterr().out
    lines = " ".join(re.sub("[│╭╮╰╯─]", " ", printed).split())
    assert "Schedules are shares of them, unless they are given in steps, as whole numbers." in lines
    assert not re.search("unless they are given in *│\n", printed)


def test_help_that_nobody_reads() -> None:
    """``--help | head`` ends without a word on stderr."""
    reader, writer = os.pipe()
    os.close(reader)
    script = "import sys; from thermosplat.cli.train import main; sys.exit(main(['--help']))"
    done = in_a_process(script, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert done.stderr == ""
    assert done.returncode in (0, 141)


@pytest.mark.rotating("commands in processes")
@pytest.mark.parametrize("command", ["train", "evaluate", "render", "export"])
def test_ctrl_c_waits_for_imports(command: str, tmp_path: Path) -> None:
    """C++ would report it as a broken installation; so the import is completed first, and then the command ends."""
    script = INTERRUPTED_IMPORT.format(command=command, folder="sample" if command == "train" else tmp_path)
    done = in_a_process(script, capture_output=True, cwd=tmp_path)
    assert done.stdout.split("\n")[-2] == "130 True", done.stderr
    assert "Traceback" not in done.stderr
