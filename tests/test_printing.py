"""What is printed cannot command the terminal, and printing ends no command; nobody prints in another way."""

import ast
import contextlib
import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.live import Live
from rich.text import Text

from thermosplat.printing import SafeConsole, help_printed, print_last, printable, safe_output
from training_processes import environment

SOURCE = Path(__file__).parents[1] / "src" / "thermosplat"
NAME = "a\x1b]0;title\x07\u202eb\n\r\t\x9b2J\u200f" + os.fsdecode(b"\xfc.jpg")
"""Of a file that sets the terminal's title, clears its screen, turns the direction of writing, and is no UTF-8."""
SHOWN = r"a\x1b]0;title\x07\u202eb\n\r\t\x9b2J\u200f\xfc.jpg"


class Full(io.StringIO):
    """An output that takes nothing any more."""

    def write(self, text: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_signs_that_terminals_act_upon_are_escaped() -> None:
    """All others, of any writing, stay as they are; a text may keep its lines."""
    assert printable(NAME) == SHOWN
    assert printable("Ünïcode 温度 °C") == "Ünïcode 温度 °C"
    assert printable("a\nb\x1b", lines=True) == "a\nb\\x1b"
    assert all(printable(chr(sign)).isprintable() for sign in range(0x11000))


def test_print_is_safe_in_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    """On both outputs, and a name adds no line on standard output; afterwards print() is as it was."""
    with safe_output():
        print(NAME)
        print(NAME, file=sys.stderr)
        with safe_output():
            print("\x07")
    assert capsys.readouterr() == (f"{SHOWN}\n\\x07\n", SHOWN.replace(r"b\n", "b\n") + "\n")
    print("\x07")
    assert capsys.readouterr().out == "\x07\n"


@pytest.mark.parametrize("in_command", [True, False])
def test_a_console_adds_its_own_commands_alone(in_command: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A live line on a terminal moves the cursor; the name in it does not."""
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with safe_output() if in_command else contextlib.nullcontext():
        console = SafeConsole(width=200)
        with Live(Text(NAME), console=console, auto_refresh=False) as live:
            live.update(Text(f"[bold]{NAME}"), refresh=True)
            print(NAME)
    said = terminal.getvalue()
    assert "\x1b[?25l" in said
    assert r"[bold]a\x1b]0;title\u202eb" in said  # rich leaves the bell out
    assert not set(NAME) & {*"\x07\x9b\u202e\u200f"} & set(said)
    assert "\x1b]" not in said


def test_a_help_keeps_its_colors_and_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless a word that it may repeat could command the terminal."""
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    with safe_output():
        for words in (["--help"], ["\x1b[2J"]):
            with help_printed(words):
                print("\x1b[1mbold\n\x1b[0m")
        print("a\nb")
    assert sys.stdout.getvalue() == "\x1b[1mbold\n\x1b[0m\n\\x1b[1mbold\n\\x1b[0m\na\\nb\n"


@pytest.mark.parametrize("errors", ["strict", "surrogateescape"])
def test_what_the_terminal_lacks_is_escaped(errors: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal without some sign ends no command, nor does one with LANG=C."""
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors=errors)
    monkeypatch.setattr(sys, "stdout", stdout)
    with safe_output():
        print("°C")
    assert stdout.buffer.getvalue() == b"\\xb0C\n"


def test_a_full_disk_is_told_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The command goes on; its last words are said where they can be read."""
    monkeypatch.setattr(sys, "stdout", Full())
    with safe_output():
        print("lost")
        SafeConsole().print("lost too")
        print_last("saved", "go on")
    told = "The output cannot be written (No space left on device). The command goes on."
    assert capsys.readouterr().err == f"{told}\nsaved\ngo on\n"
    monkeypatch.setattr(sys, "stderr", Full())
    with safe_output():
        print("lost", file=sys.stderr)
        print_last("nobody hears this")


@pytest.mark.rotating
@pytest.mark.parametrize(
    ("words", "outputs"),
    [
        ("train --version", "> /dev/full"),
        ("train --help", "> /dev/full"),
        ("prepare /nowhere", "> /dev/full 2> /dev/full"),
        ("train --nonsense", ">&- 2>&-"),
        ("", "> /dev/full 2> /dev/full"),
        ("view --help", "<&- >&- 2>&-"),
    ],
)
def test_commands_end_as_ever_without_an_output(words: str, outputs: str, tmp_path: Path) -> None:
    """With the code of the command, also where Python's own end would fail to write what is left."""
    command = f"{sys.executable} -m thermosplat {words} {outputs}"
    done = subprocess.run(command, shell=True, cwd=tmp_path, env=environment(), capture_output=True, text=True)
    assert done.returncode == (0 if "--version" in words or "--help" in words else 2)
    assert "Traceback" not in done.stderr
    assert ("cannot be written" in done.stderr) == (outputs == "> /dev/full" and done.returncode == 0)


def test_nobody_prints_in_another_way() -> None:
    """Consoles are safe ones, bars and live lines get one, and nothing writes past ``sys.stdout``."""
    found = [
        f"{path.relative_to(SOURCE)}:{node.lineno}: {ast.unparse(node)[:80]}"
        for path in SOURCE.rglob("*.py")
        if path.name != "printing.py"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if prints_past_the_door(node)
    ]
    assert found == []


def prints_past_the_door(node: ast.AST) -> bool:
    """Whether it prints with a console of rich's own, or writes to a descriptor or to the interpreter's own streams."""
    if isinstance(node, ast.Attribute):
        return node.attr in ("__stdout__", "__stderr__")
    if not isinstance(node, ast.Call):
        return False
    name = ast.unparse(node.func)
    if name in ("track", "Progress", "Live", "Status"):
        return not any(keyword.arg == "console" for keyword in node.keywords)
    return name in ("Console", "rich.print", "rich.get_console") or name.startswith("logging.basicConfig")


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("Console(stderr=True).print(1)", True),
        ("track(items, 'doing')", True),
        ("track(items, 'doing', console=console)", False),
        ("sys.__stdout__.write('')", True),
        ("SafeConsole()", False),
        ("print(path)", False),
    ],
)
def test_the_lint_sees(line: str, found: bool) -> None:
    """It can fail."""
    assert any(map(prints_past_the_door, ast.walk(ast.parse(line)))) == found
