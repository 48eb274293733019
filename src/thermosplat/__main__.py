"""``thermosplat train DATA``, or ``python -m thermosplat train DATA``, does what ``thermosplat-train DATA`` does.

So for every command.
"""

import sys
from importlib import import_module

from thermosplat import __version__
from thermosplat.printing import safe_output

COMMANDS = {
    "prepare": "thermosplat.cli.prepare",
    "train": "thermosplat.cli.train",
    "eval": "thermosplat.cli.evaluate",
    "render": "thermosplat.cli.render",
    "view": "thermosplat.cli.view",
    "export": "thermosplat.cli.export",
    "measure": "thermosplat.cli.measure",
    "report": "thermosplat.cli.report",
    "compare": "thermosplat.cli.compare",
    "benchmark": "thermosplat.cli.benchmark",
}
"""Module of each command, whose ``main`` takes the other words."""


def main(argv: list[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: The command and its words. None: the process's.

    Returns:
        The command's exit code; 2 where there is no such command.
    """
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in COMMANDS:
        return import_module(COMMANDS[words[0]]).main(words[1:])
    usage = f"usage: thermosplat {'|'.join(COMMANDS)} ...    (each has --help)"
    asked = words in (["--help"], ["-h"])
    if words == ["--version"]:
        usage, asked = f"thermosplat {__version__}", True
    with safe_output():
        if not asked:
            print(f"There is no command {words[0]!r}." if words else "No command given.", file=sys.stderr)
        print(usage, file=sys.stdout if asked else sys.stderr)
    return 0 if asked else 2


if __name__ == "__main__":
    sys.exit(main())
