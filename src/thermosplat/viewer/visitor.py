"""One tab of a browser: its camera, its controls, and the thread that makes its pictures.

Pictures are small while the camera moves, as large as this machine can make them smoothly, and of full size when it
rests. Controls are heard in viser's loop, and done one after the other in a thread of the tab (``errands``); they
change the session's wish and wake the thread of the pictures.
"""

import math
import secrets
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.novel_views.camera_paths import interpolated_path
from thermosplat.pictures.image_display import write_png
from thermosplat.viewer.cameras_panel import CamerasPanel
from thermosplat.viewer.errands import Errand, Errands
from thermosplat.viewer.freed_memory import give_back
from thermosplat.viewer.measure_panel import MeasurePanel
from thermosplat.viewer.measurements import save_measurements
from thermosplat.viewer.notices import NOTICES
from thermosplat.viewer.orbit import orbit
from thermosplat.viewer.pace import Pace
from thermosplat.viewer.page_state import state_html
from thermosplat.viewer.picture_sizes import fitting
from thermosplat.viewer.session import Unwanted, ViewSession
from thermosplat.viewer.training_panel import TrainingPanel
from thermosplat.viewer.turns import ViewingEnded
from thermosplat.viewer.view_panel import ViewPanel
from thermosplat.viewer.viewed_scene import ViewedScene
from thermosplat.viewer.wish import Shown

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
START_SECONDS = 2.0
"""So long a tab's first picture waits for its camera: a page says where viser's own camera is before it has heard where
this one begins."""


class Visitor:
    """A tab and what it sees.

    Args:
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
        self._moved = 0.0
        self.errands = Errands(f"viewer {client.client_id}, controls", self.tell)
        self._thread = threading.Thread(target=self._make_pictures, name=f"viewer {client.client_id}", daemon=True)
        self._state: Any = None
        self.panels: list[Any] = []

    def begin(self) -> None:
        """Build the controls, and begin to send pictures."""
        self.errands.begin()
        gui = self.client.gui
        self._state = gui.add_html(self._state_html(None))
        tabs = gui.add_tab_group()
        with tabs.add_tab("View"):
            self.panels.append(ViewPanel(self))
        with tabs.add_tab("Measure"):
            self.panels.append(MeasurePanel(self))
        with tabs.add_tab("Cameras"):
            self.panels.append(CamerasPanel(self))
        if self.shared.watch is not None:
            with tabs.add_tab("Training"):
                self.panels.append(TrainingPanel(self, self.shared.watch))
        self.client.camera.on_update(self._camera_told)
        self._thread.start()

    def leave(self) -> None:
        """The tab was closed: let everything end that is made for it. Returns at once."""
        self.session.gone.set()
        for panel in self._panels_of(MeasurePanel):
            panel.leave()
        self.errands.end()
        self.wake()
        self.client.camera._state.camera_cb.clear()  # viser keeps the handle for a while

    def join(self, seconds: float) -> bool:
        """Wait until nothing is done any more for a tab that was closed; whether that is so after so many seconds."""
        until = time.monotonic() + seconds
        threads = [thread for thread in (self._thread, *self.errands.threads) if thread.is_alive()]
        for thread in threads:
            thread.join(max(0.0, until - time.monotonic()))
        return not any(thread.is_alive() for thread in threads)

    # ---- what is asked for -------------------------------------------------------------------------------------------

    def heard(self, work: Errand) -> Callable[[Any], Awaitable[None]]:
        """What viser calls when a control was used on the page: the work is done after what was asked for before.

        Args:
            work: Reads the controls when it is done.
        """

        async def hear(event: Any) -> None:
            if event.client is not None:  # not the viewer itself, which shows a value
                self.errands.add(work)

        return hear

    def heard_here(self, work: Callable[[Bookmark], None]) -> Callable[[Any], Awaitable[None]]:
        """As ``heard``, for work that gets the view at which the control was used."""

        async def hear(event: Any) -> None:
            if event.client is not None:
                self.errands.add(partial(work, self.view()))

        return hear

    def pointed(self, work: Callable[[Any, Shown | None], None]) -> Callable[[Any], Awaitable[None]]:
        """What viser calls when somebody points at the picture: as ``heard``, with the picture that was pointed at."""

        async def hear(event: Any) -> None:
            self.errands.add(partial(work, event, self.session.shown))

        return hear

    # ---- what is seen ------------------------------------------------------------------------------------------------

    @property
    def scene(self) -> ViewedScene:
        """The scene."""
        return self.shared.scene

    def _panels_of(self, kind: type[Panel]) -> list[Panel]:
        """The tab's panels of a kind; none before it began, and after it was closed."""
        return [panel for panel in self.panels if isinstance(panel, kind)]

    def view(self, name: str = "") -> Bookmark:
        """Where the tab's camera is."""
        from viser import transforms

        camera = self.client.camera
        pose = np.eye(4)
        pose[:3, :3] = transforms.SO3(np.asarray(camera.wxyz, np.float64)).normalize().as_matrix()
        pose[:3, 3] = camera.position
        return Bookmark(name, np.linalg.inv(pose).astype(np.float64), math.degrees(camera.fov))

    def full_size(self) -> tuple[int, int]:
        """Size of the picture at rest [px]."""
        width, height = self.window_size()
        return max(1, round(self.at_rest * width)), max(1, round(self.at_rest * height))

    def window_size(self) -> tuple[int, int]:
        """Size of the tab's picture [px]: the window's, if that is not too large."""
        return fitting(self.client.camera.image_width, self.client.camera.image_height)

    def wish(self, **changes: Any) -> None:
        """Change what is to be seen; fields of ``Wish``."""
        self.session.wish = replace(self.session.wish, **changes)
        self.wake()

    def recalculate(self, settings: TemperatureSettings) -> None:
        """Show temperatures with other settings, and measure again what was measured."""
        self.session.recalculate(settings)
        self.wake()
        if self.session.measurements:
            self.session.renumber()

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
            if self.session.gone.wait(FLIGHT_SECONDS / steps):
                return
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

    def save_picture(self, view: Bookmark, width: int, height: int, *, with_table: bool = False) -> None:
        """Render what this tab sees from a view, with its marks, and write it beside what was saved before.

        Args:
            width: Of the picture [px], without its colour bar.
            height: Of the picture [px].
        """
        session = self.session.aside()

        def save() -> None:
            marked = session.marked(session.render(view, width, height))
            target = self.shared.new_file("measurements" if with_table else "view")
            if with_table:
                table, image = save_measurements(target.parent, target.name, session.book.pages, marked)
                self.tell("Saved", f"{table} and {image.name}")
            else:
                write_png(target.with_suffix(".png"), marked)
                self.tell("Saved", str(target.with_suffix(".png")))

        self.errands.begin_long(save)

    def tell(self, title: str, body: str = "") -> None:
        """A message on the page."""
        self.client.add_notification(title, body, auto_close_seconds=6.0)

    # ---- pictures ----------------------------------------------------------------------------------------------------

    def _camera_moved(self) -> None:
        self._moved = time.perf_counter()
        self.wake()

    async def _camera_told(self, camera: object) -> None:
        self._camera_moved()

    def _is_at_start(self) -> bool:
        """Whether the page's camera is where this viewer begins."""
        camera = self.client.camera
        told = np.concatenate([camera.position, camera.look_at, camera.up_direction])
        begins = np.concatenate([*orbit(self.scene.start(), self.scene), self.scene.up])
        return np.allclose(told, begins, rtol=1e-4, atol=1e-3 * min(1.0, self.scene.frame_spacing))

    def _make_pictures(self) -> None:
        try:
            with self._news:
                self._news.wait_for(lambda: self.session.gone.is_set() or self._is_at_start(), timeout=START_SECONDS)
            self._make_pictures_at_start()
        finally:
            self.session.forget_picture()
            self.panels.clear()
            give_back()

    def _make_pictures_at_start(self) -> None:
        resting = True  # the first picture is a small one, at once
        while True:
            with self._news:
                left = self._moved + self._rest_seconds() - time.perf_counter() if not resting else None
                self._news.wait_for(
                    lambda: self.session.gone.is_set() or self._wanted, timeout=None if left is None else max(left, 0)
                )
                if self.session.gone.is_set():
                    return
                asked, self._wanted = self._wanted, False
            resting = time.perf_counter() - self._moved >= self._rest_seconds()
            if not asked and not resting:
                continue
            try:
                self._make_picture(resting and self.pictures > 0)
            except Unwanted:
                continue
            except ViewingEnded:
                return
            except Exception as error:  # such as out of memory at a large window: the next picture may be smaller
                NOTICES.say_error("a picture could not be made", error)
                self.tell("This picture could not be made", str(error)[:300])
            if self.pictures == 1:
                resting = False

    def _rest_seconds(self) -> float:
        is_quick = self.pace.seconds(*self.full_size()) <= QUICK_SECONDS
        return REST_SECONDS if is_quick else LONG_REST_SECONDS

    def _make_picture(self, resting: bool) -> None:
        full_size = self.full_size()
        live = self.shared.watch is not None and not self.shared.watch.paused
        width, height = full_size if resting and not live else self.pace.size(*full_size)
        started = time.perf_counter()
        moved, view = self._moved, self.view()
        full = resting or live
        shown = self.session.render(view, width, height, full=full, unwanted=lambda: resting and self._moved != moved)
        if self.session.gone.is_set():
            raise ViewingEnded
        quality = RESTING_QUALITY if resting else MOVING_QUALITY
        with self.client.atomic():
            self.client.scene.set_background_image(shown.picture, format="jpeg", jpeg_quality=quality)
            self._state.content = self._state_html(shown)
        self.client.flush()
        self.pictures += 1
        if shown.full:
            for panel in self._panels_of(ViewPanel):
                panel.show_range()
        if (width, height) != full_size and not live:
            self.pace.took(width, height, time.perf_counter() - started)

    def _state_html(self, shown: Shown | None) -> str:
        return state_html(self.key, self.pictures, self.session, shown)
