"""Nobody comes in from where they should not: hosts, origins and tokens, at a server that really serves."""

import http.client
import importlib.metadata
from collections.abc import Iterator
from importlib.util import find_spec

import pytest

from thermosplat.errors import UserError
from thermosplat.viewer.door import Door, address, is_this_machine, open_server

pytestmark = pytest.mark.skipif(find_spec("viser") is None, reason="viser is not installed (the extra viewer)")


def serving(host: str) -> Iterator[tuple[Door, int]]:
    door = Door(host, {"echo": lambda words: words})
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
    yield from serving("127.0.0.1")


@pytest.fixture(scope="module")
def public() -> Iterator[tuple[Door, int]]:
    yield from serving("0.0.0.0")


def get(port: int, path: str, **headers: str) -> tuple[int, bytes, str]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    response = connection.getresponse()
    found = response.status, response.read(), response.headers.get("Location", "")
    connection.close()
    return found


def opened(port: int, path: str, **headers: str) -> bool:
    """Whether a websocket is opened there."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    try:
        with connect(
            f"ws://127.0.0.1:{port}{path}",
            additional_headers=headers,
            subprotocols=[f"viser-v{importlib.metadata.version('viser')}"],
            open_timeout=120,
            compression=None,
        ):
            return True
    except InvalidStatus as error:
        if error.response.status_code != 403:
            raise
        return False


def test_addresses_of_this_machine() -> None:
    """Loopback addresses of both kinds, and localhost; nothing else."""
    assert all(map(is_this_machine, ("127.0.0.1", "127.8.8.8", "::1", "[::1]", "localhost", "LocalHost")))
    assert not any(map(is_this_machine, ("0.0.0.0", "192.168.1.2", "::", "evil.com", "", "localhost.evil.com")))


def test_the_page_and_its_answers(local: tuple[Door, int]) -> None:
    """The page has the script in it; questions are answered as JSON; other files are viser's."""
    door, port = local
    status, page, _ = get(port, "/")
    assert (status, door.token) == (200, "")
    assert b"ts-wipe" in page[:8000]
    assert get(port, "/view/echo?x=1&y=a%20b")[1] == b'{"x": "1", "y": "a b"}'
    assert get(port, "/view/nothing")[0] == 404
    assert get(port, "/%2e%2e/%2e%2e/etc/passwd")[0] == 404


def test_other_names_of_this_machine_are_refused(local: tuple[Door, int]) -> None:
    """A site whose name leads to 127.0.0.1 gets nothing, neither page nor websocket."""
    _, port = local
    assert get(port, "/", Host="evil.com")[0] == 403
    assert get(port, "/view/echo", Host=f"evil.com:{port}")[0] == 403
    assert get(port, "/", Host=f"localhost:{port}")[0] == 200
    assert not opened(port, "/", Host="evil.com")


def test_websockets_are_for_the_viewers_own_page(local: tuple[Door, int]) -> None:
    """A page of another site may not open one, whatever its browser lets it do."""
    _, port = local
    assert opened(port, "/", Origin=f"http://127.0.0.1:{port}")
    assert not opened(port, "/", Origin="http://evil.com")
    assert not opened(port, "/", Origin=f"http://127.0.0.1:{port + 1}")
    assert not opened(port, "/", Origin="null")


def test_from_elsewhere_every_request_needs_the_token(public: tuple[Door, int]) -> None:
    """Page, questions, files and websocket: 403 without it, with a part of it and with another one."""
    door, port = public
    token = door.token
    assert len(token) >= 32
    for path in ("/", "/index.html", "/view/echo", f"/{token[:-1]}/", f"/x{token}/", f"/view/{token}/", "//", ""):
        assert get(port, path or "/")[0] == 403, path
        assert not opened(port, path)
    assert get(port, f"/{token}/")[0] == 200
    assert get(port, f"/{token}/view/echo?a=1")[1] == b'{"a": "1"}'
    assert get(port, f"/{token}")[::2] == (301, f"/{token}/")
    assert opened(port, f"/{token}")
    assert not opened(port, f"/{token}", Origin="http://evil.com")


def test_each_server_has_a_token_of_its_own() -> None:
    """Tokens are drawn, not made from anything."""
    assert len({Door("0.0.0.0", {}).token for _ in range(20)}) == 20


def test_nothing_is_published(local: tuple[Door, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """viser's share links, which any page may ask for, open no tunnel."""
    made: list[object] = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *a, **k: made.append(a))
    server = open_server("127.0.0.1", 0, Door("127.0.0.1", {}))
    try:
        assert server.request_share_url() is None
        assert not made
    finally:
        server.stop()


def test_an_address_that_is_not_ours_is_told() -> None:
    """One sentence, at once."""
    with pytest.raises(UserError, match=r"Cannot serve at the address 192\.0\.2\.1"):
        open_server("192.0.2.1", 0, Door("192.0.2.1", {}))


def test_a_viser_that_passes_the_door_by_is_not_served(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where viser starts its server in another way, there is an error and no open server."""
    import websockets.asyncio.server as websockets_server

    serve = websockets_server.serve
    monkeypatch.setattr("thermosplat.viewer.door._guarded", lambda door: __import__("contextlib").nullcontext())
    with pytest.raises(UserError, match="not known to this viewer"):
        open_server("127.0.0.1", 0, Door("127.0.0.1", {}))
    assert websockets_server.serve is serve
