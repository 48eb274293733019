"""One tab of a browser: its camera, its controls, and the thread that makes its pictures.

Pictures are small while the camera moves, as large as this machine can make them smoothly, and of full size when it
rests. Controls call from viser's threads; they change the session's wish and wake the thread.
"""

import html
import math
import secrets
import threading
import time
import traceback
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.novel_views.camera_paths import interpolated_path
from thermosplat.viewer.cameras_panel import CamerasPanel
from thermosplat.viewer.legend import legend_html
from thermosplat.viewer.measure_panel import MeasurePanel
from thermosplat.viewer.pace import Pace
from thermosplat.viewer.session import Shown, ViewSession
from thermosplat.viewer.training_panel import TrainingPanel
from thermosplat.viewer.turns import ViewingEnded
from thermosplat.viewer.view_panel import ViewPanel
from thermosplat.viewer.viewed_scene import ViewedScene

if TYPE_CHECKING:
    import viser

    from thermosplat.viewer.front_end import Shared

Panel = TypeVar("Panel")
REST_SECONDS, LONG_REST_SECONDS = 0.25, 1.0
"""Without a new place of the camera for that long, it rests; the second where a picture at rest takes long, for which
nobody who goes on moving wants to wait."""
QUICK_SECONDS = 0.5
"""A picture at rest that takes no longer than this is quick."""
MOVING_QUALITY, RESTING_QUALITY = 70, 95
"""JPEG qualities."""
FLIGHT_SECONDS = 0.7
LARGEST_SIDE = 4096
"""Of a picture on the page [px]: a browser states the size of its window."""


class Visitor:
    """A tab and what it sees.

    Args:
        client: viser's handle of it.
        session: What it looks at.
        shared: What it shares with the others.
    """

    def __init__(self, client: "viser.ClientHandle", session: ViewSession, shared: "Shared") -> None:
        self.client = client
        self.session = session
        self.shared = shared
        self.key = secrets.token_urlsafe(16)
        """Known to this tab alone: requests of its page name it."""
        self.at_rest = 1.0
        """Share of the window's width that the picture at rest has."""
        self.pace = Pace()
        self.pictures = 0
        """Pictures sent."""
        self._news = threading.Condition()
        self._wanted = True
        self._gone = False
        self._moved = 0.0
        self._thread = threading.Thread(target=self._make_pictures, name=f"viewer {client.client_id}", daemon=True)
        self._state: Any = None
        self._panels: list[Any] = []

    def begin(self) -> None:
        """Build the controls, and begin to send pictures."""
        gui = self.client.gui
        self._state = gui.add_html(self._state_html(None))
        tabs = gui.add_tab_group()
        with tabs.add_tab("View"):
            self._panels.append(ViewPanel(self))
        with tabs.add_tab("Measure"):
            self._panels.append(MeasurePanel(self))
        with tabs.add_tab("Cameras"):
            self._panels.append(CamerasPanel(self))
        if self.shared.watch is not None:
            with tabs.add_tab("Training"):
                self._panels.append(TrainingPanel(self, self.shared.watch))
        self.client.camera.on_update(self._camera_moved)
        self._thread.start()

    def leave(self) -> None:
        """The tab was closed: stop, and let everything go that was made for it."""
        with self._news:
            self._gone = True
            self._news.notify_all()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout=5)
        self.session.forget_picture()
        self._panels.clear()
        self.client.camera._state.camera_cb.clear()  # viser keeps the handle for a while

    # ---- what is seen ------------------------------------------------------------------------------------------------

    @property
    def scene(self) -> ViewedScene:
        """The scene."""
        return self.shared.scene

    def _panels_of(self, kind: type[Panel]) -> list[Panel]:
        """The tab's panels of a kind; none before it began, and after it was closed."""
        return [panel for panel in self._panels if isinstance(panel, kind)]

    def view(self, name: str = "") -> Bookmark:
        """Where the tab's camera is."""
        camera = self.client.camera
        pose = np.eye(4)
        pose[:3, :3] = rotation(camera.wxyz)
        pose[:3, 3] = camera.position
        return Bookmark(name, np.linalg.inv(pose).astype(np.float64), math.degrees(camera.fov))

    def full_size(self) -> tuple[int, int]:
        """Size of the picture at rest [px]."""
        camera = self.client.camera
        width, height = max(1, camera.image_width), max(1, camera.image_height)
        factor = min(1.0, LARGEST_SIDE / max(width, height)) * self.at_rest
        return max(1, round(factor * width)), max(1, round(factor * height))

    def wish(self, **changes: Any) -> None:
        """Change what is to be seen; fields of ``Wish``."""
        self.session.wish = replace(self.session.wish, **changes)
        self.wake()

    def set_share(self, share: float) -> None:
        """Move the edge of the wipe, or change the blend."""
        self.wish(share=share)
        for panel in self._panels_of(ViewPanel):
            panel.show_share(share)

    def lay_photograph(self, on: bool) -> None:
        """Lay the nearest photograph over the picture, or take it off."""
        if any(self.session.wish.first.spectrum in frame.views for frame in self.scene.frames):
            self.wish(over=on)

    def wake(self) -> None:
        """Make a picture: something has changed."""
        with self._news:
            self._wanted = True
            self._news.notify_all()

    def model_changed(self) -> None:
        """The scene was trained further."""
        self.session.forget_picture()
        self.wake()
        self.training_went_on()

    def training_went_on(self) -> None:
        """Show how far the training is."""
        for panel in self._panels_of(TrainingPanel):
            panel.update()

    def fly_to(self, target: Bookmark) -> None:
        """Move the camera to a view, along a smooth path."""
        start, camera = self.view(), self.client.camera
        viewmats = np.stack([start.viewmat, target.viewmat])
        steps = max(2, round(FLIGHT_SECONDS * 20))
        for index, viewmat in enumerate(interpolated_path(viewmats, steps)):
            share = index / (steps - 1)
            at = Bookmark("", viewmat, start.fov_y + share * (target.fov_y - start.fov_y))
            position, look_at = orbit(at, self.scene)
            with self.client.atomic():
                camera.up_direction = tuple(-viewmat[1, :3])
                camera.position = position
                camera.look_at = look_at
                camera.fov = math.radians(at.fov_y)
            self.client.flush()
            self._camera_moved()
            time.sleep(FLIGHT_SECONDS / steps)

    def tell(self, title: str, body: str = "") -> None:
        """A message on the page."""
        self.client.add_notification(title, body, auto_close_seconds=6.0)

    # ---- pictures ----------------------------------------------------------------------------------------------------

    def _camera_moved(self, camera: object = None) -> None:
        self._moved = time.perf_counter()
        self.wake()

    def _make_pictures(self) -> None:
        resting = True  # the first picture is a small one, at once
        while True:
            with self._news:
                left = self._moved + self._rest_seconds() - time.perf_counter() if not resting else None
                self._news.wait_for(lambda: self._gone or self._wanted, timeout=None if left is None else max(left, 0))
                if self._gone:
                    return
                asked, self._wanted = self._wanted, False
            resting = time.perf_counter() - self._moved >= self._rest_seconds()
            if not asked and not resting:
                continue
            try:
                self._make_picture(resting and self.pictures > 0)
            except ViewingEnded:
                return
            except Exception as error:  # such as out of memory at a large window: the next picture may be smaller
                traceback.print_exc()
                self.tell("This picture could not be made", str(error)[:300])
            if self.pictures == 1:
                resting = False

    def _rest_seconds(self) -> float:
        is_quick = self.pace.seconds(*self.full_size()) <= QUICK_SECONDS
        return REST_SECONDS if is_quick else LONG_REST_SECONDS

    def _make_picture(self, resting: bool) -> None:
        full = self.full_size()
        live = self.shared.watch is not None and not self.shared.watch.paused
        width, height = full if resting and not live else self.pace.size(*full)
        started = time.perf_counter()
        shown = self.session.render(self.view(), width, height, full=resting or live)
        quality = RESTING_QUALITY if resting else MOVING_QUALITY
        with self.client.atomic():
            self.client.scene.set_background_image(shown.picture, format="jpeg", jpeg_quality=quality)
            self._state.content = self._state_html(shown)
        self.client.flush()
        self.pictures += 1
        if shown.full:
            for panel in self._panels_of(ViewPanel):
                panel.show_range()
        if (width, height) != full and not live:
            self.pace.took(width, height, time.perf_counter() - started)

    def _state_html(self, shown: Shown | None) -> str:
        """What the page's script reads: who this tab is, where the wipe is, and the legend."""
        wish = self.session.wish
        wipe = f"{wish.share:.4f}" if wish.comparison == "wipe" else ""
        size, legend = "", ""
        if shown is not None:
            title = wish.first.label
            if wish.comparison == "wipe":
                title = f"{wish.first.label}  |  {wish.second.label}"
            elif wish.comparison == "blend":
                title = f"{wish.first.label} + {wish.second.label}"
            if wish.over:
                title = f"photograph over {title}"
            legend = legend_html(title, self.session.legend(shown), "" if shown.full else "moving")
            size = f"{shown.picture.shape[1]}x{shown.picture.shape[0]}"
        return (
            f'<div id="thermosplat-state" style="display:none" data-key="{html.escape(self.key)}" '
            f'data-wipe="{wipe}" data-version="{self.pictures}" data-size="{size}" '
            f'data-full="{int(shown is not None and shown.full)}">{legend}</div>'
        )


def orbit(view: Bookmark, scene: ViewedScene) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Place of a camera, and the point on its axis nearest to what the photographs look at, around which it turns."""
    pose = np.linalg.inv(view.viewmat)
    position, forward = pose[:3, 3], pose[:3, 2]
    distance = float((scene.focus - position) @ forward)
    if distance <= 0.1 * scene.frame_spacing:
        distance = 3 * scene.frame_spacing
    return tuple(map(float, position)), tuple(map(float, position + distance * forward))


def rotation(wxyz: NDArray[np.floating]) -> NDArray[np.float64]:
    """The rotation matrix of a quaternion, shape [3, 3]."""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
