"""--viewer takes a port or none, and is no part of what a run's configuration says."""

import pytest

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.viewer_flags import ViewerFlags, viewer_flags, with_viewer_port
from thermosplat.errors import UserError


@pytest.mark.parametrize(
    ("words", "port", "host"),
    [
        ([], None, "127.0.0.1"),
        (["--viewer"], 8080, "127.0.0.1"),
        (["--viewer", "9000"], 9000, "127.0.0.1"),
        (["--viewer=9000", "--viewer-host", "0.0.0.0"], 9000, "0.0.0.0"),
        (["--viewer", "--viewer-host=::1"], 8080, "::1"),
        (["--viewer", "1", "--viewer"], 8080, "127.0.0.1"),
        (["--viewer_host", "::1", "--viewer", "None"], None, "::1"),
    ],
)
def test_a_port_may_follow_the_viewer_flag(words: list[str], port: int | None, host: str) -> None:
    """Without a number the port is 8080; the last flag counts; the parser understands each of these."""
    assert viewer_flags(["sample", *words]) == ViewerFlags(port, host)
    assert parse_train_arguments(["sample", *words]) == parse_train_arguments(["sample"])


def test_the_capture_may_follow_the_flag() -> None:
    """A word that is no number is not the port."""
    assert with_viewer_port(["--viewer", "sample"]) == ["--viewer", "8080", "sample"]
    assert parse_train_arguments(["--viewer", "sample"]).data == "sample"


def test_a_port_is_a_number() -> None:
    """Anything else after = ends with the parser's message."""
    with pytest.raises(SystemExit) as stop:
        parse_train_arguments(["sample", "--viewer=x"])
    assert stop.value.code == 2


@pytest.mark.parametrize("port", ["65536", "99999999999"])
def test_a_port_beyond_the_last_is_told(port: str) -> None:
    """Before anything is loaded."""
    with pytest.raises(UserError, match="--viewer must lie between 0 and 65535"):
        parse_train_arguments(["sample", "--viewer", port])
