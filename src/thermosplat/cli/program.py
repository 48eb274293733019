"""From a command line to an exit code."""

import sys
from collections.abc import Callable

from thermosplat.cli.command_line import Arguments, parse_command_line
from thermosplat.cli.errors import run_command


def run_program(kind: type[Arguments], body: Callable[[Arguments], int], argv: list[str] | None, *, prog: str) -> int:
    """Understand a command line and do what it says.

    Args:
        kind: As of ``parse_command_line``, with a flag ``debug``.
        body: What the program does; returns the exit code.
    """
    words = sys.argv[1:] if argv is None else argv
    return run_command(lambda: body(parse_command_line(kind, words, prog=prog)), debug="--debug" in words)


def program(kind: type[Arguments], body: Callable[[Arguments], int], *, prog: str) -> Callable[..., int]:
    """The ``main`` of a program: takes words (None: the process's), returns the exit code; arguments as above."""

    def main(argv: list[str] | None = None) -> int:
        return run_program(kind, body, argv, prog=prog)

    return main
