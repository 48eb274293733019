"""Who may come in, and what may be said there: the web server of viser, with a guard at its door.

viser serves a page and a websocket on one port, to whoever asks. Here every request is looked at first:

- Bound to this machine (127.0.0.1), the address that a browser asks for must be this machine's. So a web site cannot
  reach the viewer under a name of its own that leads here (DNS rebinding).
- A websocket may only be opened by the viewer's own page (its ``Origin``), not by one of another site.
- Bound to another address, every request, the websocket's too, must begin with a random token: http://HOST:PORT/TOKEN/.
- A request that is no proper one is answered with 400, never with a traceback on the terminal.
- What comes over a websocket is looked at message by message (``page_messages``), at a bounded pace.

Connections are not encrypted. Whoever can listen on the way sees the token and the pictures.
"""

import asyncio
import contextlib
import hmac
import io
import json
import logging
import re
import secrets
import warnings
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from thermosplat.errors import UserError
from thermosplat.viewer.addresses import free_port, host_of, is_origin, is_this_machine
from thermosplat.viewer.notices import NOTICES
from thermosplat.viewer.page_messages import A_SECOND, LARGEST_MESSAGE, Control, Refused, admitted

if TYPE_CHECKING:
    import viser

Answer = Callable[[dict[str, str]], Any]
"""From the words of a query to what JSON can say."""
DEFAULT_PORT = 8080
MOST_TABS = 16
"""Tabs that may be open: each has pictures and values of its own in memory."""
MOST_CONNECTIONS = 100
"""Connections that may be open, requests that are answered included."""
_INSTALL = 'Install it: pip install ".[viewer]" in the repository.'
_PATH = re.compile(r"/[\x21-\x7e]*")


class Door:
    """Looks at every request, and at every message.

    Args:
        answers: Answers of the page's own requests, by the last part of their path: /view/<name>. One that cannot be
            given raises a ``ValueError``.
    """

    def __init__(self, host: str, answers: dict[str, Answer]) -> None:
        self.answers = answers
        self.local = is_this_machine(host)
        self.token = "" if self.local else secrets.token_urlsafe(24)
        self.is_guarding = False
        """Whether the server asks this door."""
        self.control: Callable[[str], Control | None] = lambda uuid: None
        """The input of a uuid, of any tab."""
        self._tabs = 0
        self._page: bytes | None = None

    # ---- requests ----------------------------------------------------------------------------------------------------

    def answer(self, connection: Any, request: Any, inside: Callable[[Any, Any], Any]) -> Any:
        """Answer a request, or let viser answer it.

        Returns:
            A response; None lets a websocket be opened.
        """
        if len(connection.server.handlers) > MOST_CONNECTIONS:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many connections.\n")
        try:
            return self._answer(connection, request, inside)
        except Exception as error:
            NOTICES.say(f"a request was refused: {error if isinstance(error, Refused) else type(error).__name__}")
            return connection.respond(HTTPStatus.BAD_REQUEST, "This is no request that is understood here.\n")

    def _answer(self, connection: Any, request: Any, inside: Callable[[Any, Any], Any]) -> Any:
        upgrades = [value.lower() for value in request.headers.get_all("Upgrade")]
        is_websocket = upgrades == ["websocket"]
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        host = host_of(hosts[0]) if len(hosts) == 1 else None
        if host is None or len(origins) > 1 or not all(map(is_origin, origins)):
            raise Refused("its Host or its Origin is none")
        if len(upgrades) > 1 or not _PATH.fullmatch(request.path):
            raise Refused("its path or its Upgrade is none")
        own = (f"http://{hosts[0].lower()}", f"https://{hosts[0].lower()}")
        if (self.local and not is_this_machine(host)) or (is_websocket and origins and origins[0].lower() not in own):
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
            return None
        if path in ("/", "/index.html"):
            return self._respond(connection, self.page, "text/html; charset=utf-8")
        name = path.removeprefix("/view/")
        if name in self.answers:
            words = {key: values[-1] for key, values in parse_qs(query, max_num_fields=20).items()}
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

    # ---- websockets --------------------------------------------------------------------------------------------------

    async def let_in(self, connection: Any, handler: Callable[[Any], Awaitable[None]]) -> None:
        """Let viser have a websocket, whose messages are looked at."""
        import viser

        asyncio.get_running_loop().set_exception_handler(_say_in_one_line)
        if connection.subprotocol != f"viser-v{viser.__version__}":  # viser would print what it calls itself
            await connection.close(1002, f"Version mismatch. Server: {viser.__version__}")
            return
        if self._tabs >= MOST_TABS:
            NOTICES.say(f"a tab was refused: {MOST_TABS} are open")
            await connection.close(1013, f"{MOST_TABS} tabs are open already.")
            return
        receive, due = connection.recv, 0.0

        async def receive_admitted() -> bytes:
            nonlocal due
            while True:
                message = await receive()
                now = asyncio.get_running_loop().time()
                due = max(due, now - 1.0) + 1.0 / A_SECOND  # a second's worth may come at once
                await asyncio.sleep(max(0.0, due - now))
                try:
                    return admitted(message, self.control)
                except Refused as error:
                    NOTICES.say(f"{error} was not taken from a page")

        connection.recv = receive_admitted
        self._tabs += 1
        try:
            await handler(connection)
        finally:
            self._tabs -= 1


def open_server(host: str, port: int, door: Door) -> "viser.ViserServer":
    """Start viser behind a door. It serves in a thread of its own.

    Args:
        port: Port to begin with; the next free one is taken.

    Raises:
        UserError: viser is not installed, or the address cannot be bound.
    """
    port = free_port(host, port)
    try:
        import viser
        import viser._messages
    except ImportError as error:
        raise UserError("The viewer needs viser, which is not installed here.", _INSTALL) from error

    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # of a tab that was closed just now

    class GuardedServer(viser.ViserServer):
        """viser's server without its public share links."""

        def request_share_url(self, verbose: bool = True) -> None:
            """Nothing is published: any page could ask for it."""

    with _guarded(door), contextlib.redirect_stdout(io.StringIO()):  # its greeting has an address without the token
        server = GuardedServer(host=host, port=port, verbose=False, label="thermosplat")
    if not door.is_guarding or not hasattr(server.gui, "_gui_input_handle_from_uuid"):  # another version of viser
        server.stop()
        raise UserError(f"viser {viser.__version__} is not known to this viewer.", 'Install another: "viser==1.1.1".')

    def control(uuid: str) -> Control | None:
        inputs = (client.gui._gui_input_handle_from_uuid.get(uuid) for client in server.get_clients().values())
        return next(filter(None, inputs), None)

    door.control = control
    return server


def address(server: "viser.ViserServer", door: Door) -> str:
    """What to open in a browser."""
    host = server.get_host()
    shown = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{shown}:{server.get_port()}/{door.token + '/' if door.token else ''}"


@contextmanager
def _guarded(door: Door) -> Iterator[None]:
    """Around the start of a server of websockets: its requests and messages go through the door."""
    import websockets.asyncio.server as websockets_server

    serve = websockets_server.serve

    def serve_guarded(handler: Any, *places: Any, **options: Any) -> Any:
        inside = options["process_request"]
        options["process_request"] = lambda connection, request: door.answer(connection, request, inside)
        options["max_size"] = LARGEST_MESSAGE
        options["logger"] = _logger()
        door.is_guarding = True

        async def handle(connection: Any) -> None:
            await door.let_in(connection, handler)

        return serve(handle, *places, **options)

    websockets_server.serve = serve_guarded
    try:
        yield
    finally:
        websockets_server.serve = serve


def _logger() -> logging.Logger:
    """Where the server of websockets says what went wrong, such as a request that is cut off."""
    logger = logging.getLogger(__name__)
    logger.handlers, logger.propagate = [NOTICES], False
    return logger


def _say_in_one_line(loop: asyncio.AbstractEventLoop, said: dict[str, Any]) -> None:
    """What went wrong in the server's loop, such as in an answer of viser's to a message."""
    error = said.get("exception")
    if error is None:
        NOTICES.say(said["message"])
    else:
        NOTICES.say_error(said["message"], error)
