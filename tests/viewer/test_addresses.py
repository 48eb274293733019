"""Hosts and origins are what the standard says, and nothing that only looks like one; ports are looked for here."""

import socket

import pytest

from thermosplat.errors import UserError
from thermosplat.viewer.addresses import free_port, host_of, is_origin, is_this_machine


def test_addresses_of_this_machine() -> None:
    """Loopback addresses of both kinds, and localhost; nothing else."""
    assert all(map(is_this_machine, ("127.0.0.1", "127.8.8.8", "::1", "localhost", "LocalHost")))
    others = ("0.0.0.0", "192.168.1.2", "::", "evil.com", "", "localhost.evil.com", "localhost.", "[::1]", "127.1")
    assert not any(map(is_this_machine, others))


@pytest.mark.parametrize(
    ("header", "host"),
    [
        ("localhost:8080", "localhost"),
        ("127.0.0.1", "127.0.0.1"),
        ("[::1]:65535", "::1"),
        ("my-machine_2.lan:80", "my-machine_2.lan"),
        *(
            (header, None)
            for header in (
                *(
                    "",
                    ":",
                    ":80",
                    "localhost:",
                    "localhost:x",
                    "localhost:65536",
                    "localhost:-1",
                    "localhost:8080:8080",
                ),
                *("evil.com@localhost", "localhost@evil.com", "user:pw@localhost", "[::1].evil.com", "[::1", "::1"),
                *("[]", "[::1]x", "[127.0.0.1]", "[::1%eth0]", "[fe80:::1]", "127.0.0.1:80, evil.com"),
                *("127.0.0.1 ", " localhost", "localhost\t", "localhost\n", "http://localhost", "localhost/x"),
                *("localhost?", "localhost#", "local\\host", "l\xf6calhost", "localhos\u0165", ".localhost", "a" * 300),
                *("localhost:8080:8080", "127.0.0.1:\u0661", "%6cocalhost", "localhost;", "*"),
            )
        ),
    ],
)
def test_a_host_is_parsed_strictly(header: str, host: str | None) -> None:
    """A name or an address, and a port; anything before, behind or between them makes it none."""
    assert host_of(header) == host
    assert is_origin(f"http://{header}") == (host is not None)


def test_an_origin_is_a_scheme_and_a_host() -> None:
    """ "null" is one, too; a page's whole address is none."""
    assert all(map(is_origin, ("null", "https://localhost", "chrome-extension://abc", "http://LOCALHOST:1")))
    assert not any(map(is_origin, ("http://[", "http://localhost/", "http:localhost", "://localhost", "nullx", "")))


def test_a_port_is_looked_for_up_to_the_last_one() -> None:
    """The next one that is free; where the last is taken there is a sentence instead of an endless wait."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port("127.0.0.1", port) > port
    with socket.socket() as taken:
        try:
            taken.bind(("127.0.0.1", 65535))
            taken.listen()
        except OSError:
            pass  # somebody else has it
        with pytest.raises(UserError, match="None of the ports 65535 to 65535 is free"):
            free_port("127.0.0.1", 65535)
    assert free_port("127.0.0.1", 0) == 0


@pytest.mark.parametrize("host", ["192.0.2.1", "", "a" * 64, "\0", "[::1]", "x\u2024y", "999.1.1.1"])
def test_an_address_that_is_not_ours_is_told(host: str) -> None:
    """One sentence, at once, whatever stands in the flag."""
    with pytest.raises(UserError, match="Cannot serve at the address"):
        free_port(host, 8080)
