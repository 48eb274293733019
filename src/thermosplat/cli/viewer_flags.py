"""The flags of thermosplat-train that show the training in the browser: --viewer [PORT] and --viewer-host."""

import re
from dataclasses import dataclass

from thermosplat.cli.flag_values import last_value
from thermosplat.errors import UserError

LOCAL_HOST = "127.0.0.1"
DEFAULT_PORT, LAST_PORT = 8080, 65_535
_FLAG, _HOST_FLAG = "--viewer", "--viewer-host"


@dataclass(frozen=True)
class ViewerFlags:
    """Where a training is shown."""

    port: int | None
    """None: nowhere."""
    host: str = LOCAL_HOST
    """Address to serve at."""


def with_viewer_port(argv: list[str]) -> list[str]:
    """A command line in which ``--viewer`` has a port, as the parser wants it."""
    words: list[str] = []
    for number, word in enumerate(argv):
        words.append(word)
        if word == _FLAG and not re.fullmatch(r"\d+|None", argv[number + 1] if number + 1 < len(argv) else ""):
            words.append(str(DEFAULT_PORT))
    return words


def viewer_flags(argv: list[str]) -> ViewerFlags:
    """What a command line that was understood says of the viewer; of several the last.

    Raises:
        UserError: The port is none.
    """
    words = with_viewer_port(argv)
    port = last_value(words, _FLAG)
    host = last_value(words, _HOST_FLAG) or last_value(words, _HOST_FLAG.replace("-h", "_h"))
    return ViewerFlags(None if port in (None, "None") else checked_port(_FLAG, int(port or 0)), host or LOCAL_HOST)


def checked_port(flag: str, port: int) -> int:
    """A port that a flag names.

    Raises:
        UserError: There is no such port.
    """
    if not 0 <= port <= LAST_PORT:
        raise UserError(f"{flag} must lie between 0 and {LAST_PORT}, found {port}.", f"Give {flag} {DEFAULT_PORT}.")
    return port
