"""Who may come in: the web server of viser, with a guard at its door and the page's own script.

viser serves a page and a websocket on one port, to whoever asks. Here every request is looked at first:

- Bound to this machine (127.0.0.1), the address that a browser asks for must be this machine's. So a web site cannot
  reach the viewer under a name of its own that leads here (DNS rebinding).
- A websocket may only be opened by the viewer's own page (its ``Origin``), not by one of another site.
- Bound to another address, every request, the websocket's too, must begin with a random token: http://HOST:PORT/TOKEN/.

Connections are not encrypted. Whoever can listen on the way sees the token and the pictures.
"""

import contextlib
import hmac
import io
import json
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from thermosplat.errors import UserError

if TYPE_CHECKING:
    import viser

Answer = Callable[[dict[str, str]], Any]
"""From the words of a query to what JSON can say."""
DEFAULT_PORT = 8080
_INSTALL = 'Install it: pip install ".[viewer]" in the repository.'


class Door:
    """Looks at every request.

    Args:
        host: Address that the server is bound to.
        answers: Answers of the page's own requests, by the last part of their path: /view/<name>.
    """

    def __init__(self, host: str, answers: dict[str, Answer]) -> None:
        self.answers = answers
        self.local = is_this_machine(host)
        self.token = "" if self.local else secrets.token_urlsafe(24)
        self.is_guarding = False
        """Whether the server asks this door."""
        self._page: bytes | None = None

    def answer(self, connection: Any, request: Any, inside: Callable[[Any, Any], Any]) -> Any:
        """Answer a request, or let viser answer it.

        Args:
            connection: The websockets connection.
            request: What is asked; its path loses the token.
            inside: viser's own answer.

        Returns:
            A response; None lets a websocket be opened.
        """
        headers = request.headers
        is_websocket = headers.get("Upgrade", "").lower() == "websocket"
        if not self._may_come(headers.get_all("Host"), headers.get_all("Origin") if is_websocket else []):
            return connection.respond(HTTPStatus.FORBIDDEN, "This page may not be reached from there.\n")
        path, _, query = request.path.partition("?")
        if self.token:
            first, _, rest = path.removeprefix("/").partition("/")
            if not hmac.compare_digest(first.encode(), self.token.encode()):
                return connection.respond(HTTPStatus.FORBIDDEN, "The address lacks the token, or has a wrong one.\n")
            if path == f"/{first}" and not is_websocket:  # the page's requests are relative to the folder
                response = connection.respond(HTTPStatus.MOVED_PERMANENTLY, "")
                response.headers["Location"] = f"/{self.token}/"
                return response
            path = f"/{rest}"
        if is_websocket:
            return inside(connection, request)
        if path in ("/", "/index.html"):
            return self._respond(connection, self.page, "text/html; charset=utf-8")
        name = path.removeprefix("/view/")
        if name in self.answers:
            words = {key: values[-1] for key, values in parse_qs(query).items()}
            said = json.dumps(self.answers[name](words), allow_nan=False).encode()
            return self._respond(connection, said, "application/json")
        request.path = path
        return inside(connection, request)

    @property
    def page(self) -> bytes:
        """viser's page with the viewer's script in it, which runs before viser's own."""
        if self._page is None:
            import viser

            html = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text(encoding="utf-8")
            script = files("thermosplat.viewer").joinpath("page.js").read_text(encoding="utf-8")
            html = html.replace("<title>Viser</title>", "<title>thermosplat</title>", 1)
            self._page = html.replace("<head>", f"<head><script>\n{script}</script>", 1).encode()
        return self._page

    def _may_come(self, hosts: list[str], origins: list[str]) -> bool:
        if len(hosts) != 1 or len(origins) > 1:
            return False
        if self.local and not is_this_machine(urlsplit(f"//{hosts[0]}").hostname or ""):
            return False
        return all(urlsplit(origin).netloc.lower() == hosts[0].lower() for origin in origins)

    def _respond(self, connection: Any, body: bytes, kind: str) -> Any:
        response = connection.respond(HTTPStatus.OK, "")
        response.body = body
        for name in ("Content-Type", "Content-Length"):
            del response.headers[name]
        response.headers["Content-Type"] = kind
        response.headers["Content-Length"] = str(len(body))
        response.headers["Cache-Control"] = "no-store"
        response.headers["Referrer-Policy"] = "no-referrer"  # the address has the token
        response.headers["X-Frame-Options"] = "DENY"
        return response


def is_this_machine(host: str) -> bool:
    """Whether an address or name is one that only this machine answers to."""
    if host.lower() == "localhost":
        return True
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def open_server(host: str, port: int, door: Door) -> "viser.ViserServer":
    """Start viser behind a door. It serves in a thread of its own.

    Args:
        host: Address to bind to.
        port: Port to begin with; the next free one is taken.
        door: The guard.

    Raises:
        UserError: viser is not installed, or the address cannot be bound.
    """
    _check_address(host)
    try:
        import viser
        import viser._messages
    except ImportError as error:
        raise UserError("The viewer needs viser, which is not installed here.", _INSTALL) from error

    class GuardedServer(viser.ViserServer):
        """viser's server without its public share links."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Nothing is published: any page could ask for it."""

    with _guarded(door), contextlib.redirect_stdout(io.StringIO()):  # its greeting has an address without the token
        server = GuardedServer(host=host, port=port, verbose=False, label="thermosplat")
    if not door.is_guarding:  # another version of viser, which starts its server in another way
        server.stop()
        raise UserError(f"viser {viser.__version__} is not known to this viewer.", 'Install another: "viser==1.1.1".')
    return server


def address(server: "viser.ViserServer", door: Door) -> str:
    """What to open in a browser."""
    host = server.get_host()
    shown = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{shown}:{server.get_port()}/{door.token + '/' if door.token else ''}"


@contextmanager
def _guarded(door: Door) -> Iterator[None]:
    """Around the start of a server of websockets: its requests go through the door."""
    import websockets.asyncio.server as websockets_server

    serve = websockets_server.serve

    def serve_guarded(handler: Any, *places: Any, **options: Any) -> Any:
        inside = options["process_request"]
        options["process_request"] = lambda connection, request: door.answer(connection, request, inside)
        door.is_guarding = True
        return serve(handler, *places, **options)

    websockets_server.serve = serve_guarded
    try:
        yield
    finally:
        websockets_server.serve = serve


def _check_address(host: str) -> None:
    """viser tries one port after the other, for an address that is not this machine's too."""
    import socket

    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
        with socket.socket(found[0][0], socket.SOCK_STREAM) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise UserError(
            f"Cannot serve at the address {host}: {error.strerror or error}.",
            "Give --host an address of this machine, or leave it out.",
        ) from error
