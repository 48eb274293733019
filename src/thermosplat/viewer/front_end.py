"""The viewer as a web server: every tab of a browser gets a session of its own, and loses it when it is closed."""

import contextlib
import io
import math
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermosplat.novel_views.bookmarks import Bookmark, read_bookmarks, write_bookmarks
from thermosplat.runs.atomic_writes import sweep
from thermosplat.spectra import CELSIUS
from thermosplat.thermography.measurement_book import MeasurementBook
from thermosplat.thermography.measurements_file import MEASUREMENTS, read_book
from thermosplat.viewer.door import DEFAULT_PORT, Door, address, open_server
from thermosplat.viewer.layers import LayerRenderer, available_layers
from thermosplat.viewer.notices import NOTICES
from thermosplat.viewer.orbit import orbit
from thermosplat.viewer.session import ViewSession
from thermosplat.viewer.training_watch import TrainingWatch
from thermosplat.viewer.turns import OneAtATime, Turns
from thermosplat.viewer.viewed_scene import ViewedScene
from thermosplat.viewer.visitor import Visitor
from thermosplat.viewer.wish import start_wish

if TYPE_CHECKING:
    import viser

ACCENT = (226, 88, 34)
"""Colour of the controls: flame."""
SECONDS_TO_END = 3.0
"""That the pictures in the making have when the viewer is stopped."""


@dataclass
class Shared:
    """What all visitors of a viewer have in common.

    Attributes:
        renderer: Renders the scene.
        folder: Where files go that visitors save.
        turns: When the model may be rendered.
        watch: The training that goes on; None: none does.
        bookmarks: One list for all.
    """

    renderer: LayerRenderer
    folder: Path
    turns: Turns
    watch: TrainingWatch | None = None
    bookmarks: list[Bookmark] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._naming = threading.Lock()
        self._named = 0
        path = self.folder / MEASUREMENTS
        self.book = MeasurementBook(path, read_book(path)[0] if path.is_file() else None)
        sweep(self.folder)  # of a video that a program which was ended left behind
        if self.bookmarks_file.is_file() and not self.bookmarks:
            placement = self.scene.model.placement
            self.bookmarks = [bookmark.in_scene(placement) for bookmark in read_bookmarks(self.bookmarks_file)]

    @property
    def scene(self) -> ViewedScene:
        """The scene."""
        return self.renderer.scene

    @property
    def bookmarks_file(self) -> Path:
        """Where bookmarks are kept."""
        return self.folder / "bookmarks.json"

    def save_bookmarks(self) -> None:
        """Write the bookmarks that there are; without any there is no file."""
        if self.bookmarks:
            placement = self.scene.model.placement
            write_bookmarks(self.bookmarks_file, [bookmark.in_world(placement) for bookmark in self.bookmarks])
        else:
            self.bookmarks_file.unlink(missing_ok=True)

    def new_file(self, kind: str) -> Path:
        """A path without an ending that no file has, in the folder for what visitors save."""
        with self._naming:  # two in one second have two names
            self._named += 1
            return self.folder / f"{kind}_{time.strftime('%Y%m%d_%H%M%S')}_{self._named:03d}"


class Viewer:
    """A scene on a page of its own.

    Args:
        folder: Where measurements, pictures and bookmarks go.
        host: Address to serve at. Other than this machine's own, the page's address has a token.
        port: Port to begin with; the next free one is taken.
        watch: The training that goes on; None: nobody changes the scene.

    Raises:
        UserError: viser is not installed, the address cannot be served at, or the file of bookmarks is none.
    """

    def __init__(
        self,
        scene: ViewedScene,
        folder: Path,
        *,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
        watch: TrainingWatch | None = None,
    ) -> None:
        turns = OneAtATime() if watch is None else watch.turns
        self.shared = Shared(LayerRenderer(scene), folder, turns, watch)
        self.visitors: dict[int, Visitor] = {}
        self._changing = threading.Lock()
        self._door = Door(host, {"probe": self._probe, "wipe": self._wipe, "over": self._over})
        self.server: viser.ViserServer = open_server(host, port, self._door)
        self.url = address(self.server, self._door)
        """What to open in a browser."""
        self._furnish()
        self.server.on_client_connect(self._enter)
        self.server.on_client_disconnect(self._leave)
        if watch is not None:
            watch.on_change, watch.on_progress = self._model_changed, self._training_went_on
            watch.has_viewers = lambda: bool(self.visitors)

    def stop(self) -> bool:
        """Close the page for everybody, and end what is made for them.

        Returns:
            Whether it has ended. A picture that is being rendered cannot be broken off, and may take longer.
        """
        with self._changing:
            visitors, self.visitors = self.visitors, {}
        self.shared.turns.end()
        for visitor in visitors.values():
            visitor.leave()
        with contextlib.redirect_stdout(io.StringIO()):  # viser's farewell
            self.server.stop()
        until = time.monotonic() + SECONDS_TO_END
        return all([visitor.join(max(0.0, until - time.monotonic())) for visitor in visitors.values()])

    def _furnish(self) -> None:
        """What is the same for everybody: colours, where the camera begins, which way is up."""
        server, scene = self.server, self.shared.scene
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=ACCENT)
        server.scene.set_up_direction(tuple(scene.up))
        server.scene.world_axes.visible = False
        start = scene.start()
        position, look_at = orbit(start, scene)
        server.initial_camera.position = position
        server.initial_camera.look_at = look_at
        server.initial_camera.fov = math.radians(start.fov_y)
        server.initial_camera.near = max(1e-3, 0.01 * scene.frame_spacing)

    def _enter(self, client: "viser.ClientHandle") -> None:
        layers = available_layers(self.shared.scene)
        measured = [name for name, scale in self.shared.scene.scales.items() if scale.measured_unit == CELSIUS]
        wish = start_wish(layers, measured)
        session = ViewSession(self.shared.renderer, self.shared.turns, wish, book=self.shared.book)
        visitor = Visitor(client, session, self.shared)
        with self._changing:
            if client.client_id not in self.server.get_clients():  # gone already
                return
            self.visitors[client.client_id] = visitor
        try:
            visitor.begin()
        except Exception as error:
            NOTICES.say_error("a tab could not be furnished", error)
            self._leave(client)

    def _leave(self, client: "viser.ClientHandle") -> None:
        with self._changing:
            visitor = self.visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.leave()

    def _model_changed(self) -> None:
        for visitor in list(self.visitors.values()):
            visitor.model_changed()

    def _training_went_on(self) -> None:
        for visitor in list(self.visitors.values()):
            visitor.training_went_on()

    # ---- what the page asks ------------------------------------------------------------------------------------------

    def _asking(self, words: dict[str, str]) -> Visitor | None:
        key = words.get("key", "")
        return next((visitor for visitor in list(self.visitors.values()) if visitor.key == key), None)

    def _probe(self, words: dict[str, str]) -> Any:
        visitor = self._asking(words)
        found = None if visitor is None else visitor.session.probe(number(words, "x"), number(words, "y"))
        return {} if found is None else {"value": found[0], "text": found[1]}

    def _wipe(self, words: dict[str, str]) -> Any:
        visitor = self._asking(words)
        if visitor is not None:
            visitor.set_share(min(max(number(words, "share"), 0.0), 1.0))
        return {}

    def _over(self, words: dict[str, str]) -> Any:
        visitor = self._asking(words)
        if visitor is not None:
            visitor.lay_photograph(words.get("on") == "1")
        return {}


def number(words: dict[str, str], name: str) -> float:
    """A finite number of a query.

    Raises:
        ValueError: There is none.
    """
    value = float(words.get(name, ""))
    if not math.isfinite(value):
        raise ValueError(f"{name} is not finite")
    return value
