"""Nobody comes in from where they should not: hosts, origins and tokens, at a server that really serves."""

import contextlib
import socket
from collections.abc import Iterator
from importlib.util import find_spec
from types import SimpleNamespace

import pytest

from thermosplat.errors import UserError
from thermosplat.viewer.door import MOST_CONNECTIONS, MOST_TABS, Door, address, open_server

if find_spec("viser") is None:
    pytest.skip("viser is not installed (the extra viewer)", allow_module_level=True)

from page_client import wait_for, websocket


@contextlib.contextmanager
def serving(host: str) -> Iterator[tuple[Door, int]]:
    door = Door(host, {"echo": lambda words: words, "number": lambda words: float(words["x"])})
    server = open_server(host, 0, door)
    try:
        assert address(server, door) == (
            f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}/"
            f"{door.token + '/' if door.token else ''}"
        )
        yield door, server.get_port()
    finally:
        server.stop()


@pytest.fixture(scope="module")
def local() -> Iterator[tuple[Door, int]]:
    with serving("127.0.0.1") as door:
        yield door


@pytest.fixture(scope="module")
def public() -> Iterator[tuple[Door, int]]:
    with serving("0.0.0.0") as door:
        yield door


def asked(port: int, path: str, *headers: str, host: str | None = "") -> tuple[int, str]:
    """Status and answer of a request, which is sent as it is written here; host: None sends none."""
    lines = [f"GET {path} HTTP/1.1", *([] if host is None else [f"Host: {host or f'127.0.0.1:{port}'}"]), *headers]
    with socket.create_connection(("127.0.0.1", port), timeout=120) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        answer = b""
        while part := connection.recv(1 << 20):
            answer += part
            if answer.startswith(b"HTTP/1.1 101"):
                break
    head, _, body = answer.decode(errors="replace").partition("\r\n\r\n")
    location = head.partition("Location: ")[2].partition("\r\n")[0]
    return int(head.split()[1]), location or body


UPGRADE = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
           "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==")  # fmt: skip


def test_the_page_and_its_answers(local: tuple[Door, int]) -> None:
    """The page has the script in it; questions are answered as JSON; other files are viser's."""
    door, port = local
    status, page = asked(port, "/")
    assert (status, door.token) == (200, "")
    assert "ts-wipe" in page[:8000]
    assert asked(port, "/view/echo?x=1&y=a%20b")[1] == '{"x": "1", "y": "a b"}'
    assert asked(port, "/view/nothing")[0] == 404
    assert asked(port, "/%2e%2e/%2e%2e/etc/passwd")[0] == 404


@pytest.mark.parametrize("host", ["evil.com", "evil.com:{port}", "localhost.evil.com", "192.168.1.1:{port}"])
def test_other_names_of_this_machine_are_refused(local: tuple[Door, int], host: str) -> None:
    """A site whose name leads to 127.0.0.1 gets nothing, neither page nor websocket."""
    _, port = local
    for headers in ((), UPGRADE):
        assert asked(port, "/view/echo", *headers, host=host.format(port=port))[0] == 403
    assert asked(port, "/", host=f"localhost:{port}")[0] == 200
    assert asked(port, "/", host="[::1]:9000")[0] == 200  # as through a tunnel


@pytest.mark.parametrize(
    ("path", "headers", "host"),
    [
        ("/", (), "evil.com@localhost"),
        ("/", (), "[::1].evil.com"),
        ("/", (), "127.0.0.1:80, evil.com"),
        ("/", (), "[::1"),
        ("/", (), None),
        ("/", ("Host: localhost",), ""),
        ("/", ("Origin: http://[",), ""),
        ("/", ("Origin: http://localhost", "Origin: http://localhost"), ""),
        ("/", (*UPGRADE, "Origin: http://127.0.0.1@evil.com"), ""),
        ("/", (*UPGRADE, "Upgrade: websocket"), ""),
        ("/", (*UPGRADE, "Upgrade: h2c"), ""),
        ("/\u00e9/", (), ""),
        ("/\x7f", (), ""),
        ("http://localhost/", (), ""),
        ("*", (), ""),
        ("/view/number?x=a", (), ""),
        ("/view/number?x=nan", (), ""),
        ("/view/number", (), ""),
        ("/view/echo?" + "a=1&" * 100, (), ""),
    ],
)
def test_what_is_no_request_is_answered_so(
    local: tuple[Door, int],
    public: tuple[Door, int],
    path: str,
    headers: tuple[str, ...],
    host: str | None,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """400, from here and from elsewhere, and a line on the terminal at most."""
    door, port = public
    from_elsewhere = f"/{door.token}{path}" if path.startswith("/") else path
    assert asked(local[1], path, *headers, host=host)[0] == 400
    assert asked(port, from_elsewhere, *headers, host=host)[0] == 400
    said = capfd.readouterr().err
    assert "Traceback" not in said
    assert said.count("\n") <= 3


def test_broken_requests_leave_no_traceback(local: tuple[Door, int], capfd: pytest.CaptureFixture[str]) -> None:
    """Requests that are cut off or no HTTP at all, and a websocket that begins wrongly; then the page is there."""
    _, port = local
    for sent in (
        b"\0\1\2\r\n\r\n",
        b"GET / HTTP/9\r\n\r\n",
        b"POST / HTTP/1.1\r\n\r\n",
        b"G",
        b"GET /" + b"a" * 99_999,
    ):
        with socket.create_connection(("127.0.0.1", port), timeout=120) as connection:
            connection.sendall(sent)
            connection.shutdown(socket.SHUT_WR)
            with contextlib.suppress(ConnectionError):
                while connection.recv(1 << 16):
                    pass
    assert asked(port, "/", *UPGRADE[:2])[0] in (400, 426)
    assert asked(port, "/")[0] == 200
    said = capfd.readouterr().err
    assert "Traceback" not in said
    assert said.count("\n") <= 8


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://127.0.0.1:{port}", 101),
        ("", 101),
        ("http://evil.com", 403),
        ("http://127.0.0.1:1", 403),
        ("http://127.0.0.1", 403),
        ("ftp://127.0.0.1:{port}", 403),
        ("null", 403),
    ],
)
def test_websockets_are_for_the_viewers_own_page(local: tuple[Door, int], origin: str, status: int) -> None:
    """A page of another site may not open one, whatever its browser lets it do."""
    _, port = local
    headers = (*UPGRADE, f"Origin: {origin.format(port=port)}") if origin else UPGRADE
    assert asked(port, "/", *headers)[0] == status


def test_from_elsewhere_every_request_needs_the_token(public: tuple[Door, int]) -> None:
    """Page, questions, files and websocket: 403 without it, with a part of it and with another one."""
    door, port = public
    token = door.token
    assert len(token) >= 32
    for path in ("/", "/index.html", "/view/echo", f"/{token[:-1]}/", f"/x{token}/", f"/view/{token}/", "//"):
        for headers in ((), UPGRADE):
            assert asked(port, path, *headers)[0] == 403, path
    assert asked(port, f"/{token}/")[0] == 200
    assert asked(port, f"/{token}/view/echo?a=1")[1] == '{"a": "1"}'
    assert asked(port, f"/{token}") == (301, f"/{token}/")
    assert asked(port, f"/{token}", *UPGRADE)[0] == 101
    assert asked(port, f"/{token}", *UPGRADE, "Origin: http://evil.com")[0] == 403


def test_each_server_has_a_token_of_its_own() -> None:
    """Tokens are drawn, not made from anything."""
    assert len({Door("0.0.0.0", {}).token for _ in range(20)}) == 20


def test_only_so_many_tabs_are_open(local: tuple[Door, int]) -> None:
    """One more is closed at once; when another one is closed there is room again."""
    _, port = local
    with contextlib.ExitStack() as opened:
        tabs = [opened.enter_context(websocket(port)) for _ in range(MOST_TABS)]
        with websocket(port) as refused, pytest.raises(Exception, match="1013"):
            refused.recv(timeout=120)
        tabs[0].close()

        from websockets.exceptions import ConnectionClosed

        def is_let_in() -> bool:
            with websocket(port) as tab:
                try:
                    return bool(tab.recv(timeout=120))
                except ConnectionClosed:  # it has not been noticed yet that the other one is gone
                    return False

        wait_for(is_let_in)


def test_only_so_many_connections_are_open(local: tuple[Door, int]) -> None:
    """Those that say nothing count, too: a request beyond them gets 503, and is answered when they have gone."""
    _, port = local
    with contextlib.ExitStack() as opened:
        for _ in range(MOST_CONNECTIONS):
            opened.enter_context(socket.create_connection(("127.0.0.1", port), timeout=120))
        wait_for(lambda: asked(port, "/")[0] == 503)
    wait_for(lambda: asked(port, "/")[0] == 200)


def test_another_version_of_the_page_is_sent_away(local: tuple[Door, int], capfd: pytest.CaptureFixture[str]) -> None:
    """What it calls itself is not printed."""
    with websocket(local[1], version="9.evil") as old, pytest.raises(Exception, match="Version mismatch"):
        old.recv()
    assert "evil" not in "".join(capfd.readouterr())


def test_nothing_is_published(monkeypatch: pytest.MonkeyPatch) -> None:
    """viser's share links, which any page may ask for, open no tunnel."""
    made: list[object] = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *a, **k: made.append(a))
    server = open_server("127.0.0.1", 0, Door("127.0.0.1", {}))
    try:
        assert server.request_share_url() is None
        assert not made
    finally:
        server.stop()


def test_a_viser_that_passes_the_door_by_is_not_served(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where viser starts its server in another way, there is an error and no open server."""
    import websockets.asyncio.server as websockets_server

    serve = websockets_server.serve
    started, stopped = [], []

    class StartedOtherwise:
        """A server that asks no door."""

        gui = SimpleNamespace(_gui_input_handle_from_uuid={})

        def __init__(self, **options: object) -> None:
            started.append(self)

        def stop(self) -> None:
            stopped.append(self)

    monkeypatch.setattr("viser.ViserServer", StartedOtherwise)
    with pytest.raises(UserError, match="not known to this viewer"):
        open_server("127.0.0.1", 0, Door("127.0.0.1", {}))
    assert started == stopped
    assert len(started) == 1
    assert websockets_server.serve is serve
