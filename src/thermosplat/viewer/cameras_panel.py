"""Controls of cameras: the frames, bookmarks, a path through them as a video, and screenshots of any size."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from thermosplat.errors import UserError
from thermosplat.novel_views.bookmarks import Bookmark, path_through
from thermosplat.pictures.image_display import Image8
from thermosplat.pictures.video import write_images
from thermosplat.viewer.picture_sizes import LARGEST_SIDE, MOST_IMAGES, fitting
from thermosplat.viewer.session import ViewSession
from thermosplat.viewer.viewed_scene import frame_bookmark

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

MOST_FRUSTA = 300
"""Of a larger capture so many are drawn, evenly chosen."""
_LEARNT, _HELD_OUT = (120, 190, 255), (255, 170, 60)
_NONE = "(none)"
_MOST_BOOKMARKS = 1000


class CamerasPanel:
    """The tab "Cameras"."""

    def __init__(self, visitor: "Visitor") -> None:
        import viser

        self.visitor = visitor
        self._frusta: list[Any] = []
        gui, scene = visitor.client.gui, visitor.scene
        frames = {frame.name: frame for frame in scene.frames if frame.views}
        if frames:
            self.shown = gui.add_checkbox("Show the frames", False, hint="Click one to fly there")
            self.frame = gui.add_dropdown("Fly to frame", tuple(frames))
            self.over = gui.add_checkbox("Photograph over it", False, hint="Or hold the key P")
            self.shown.on_update(visitor.heard(lambda: self._show_frusta(self.shown.value)))
            self.frame.on_update(visitor.heard(lambda: self._fly(frames[self.frame.value])))
            self.over.on_update(visitor.heard(lambda: visitor.lay_photograph(self.over.value)))
        with gui.add_folder("Bookmarks"):
            self.name = gui.add_text("Name", "")
            self.add = gui.add_button("Add this view", icon=viser.Icon.BOOKMARK)
            self.choice = gui.add_dropdown("Fly to", (_NONE,))
            self.remove = gui.add_button("Delete it")
            self.add.on_click(visitor.heard_here(self._add))
            self.remove.on_click(visitor.heard(self._remove))
            self.choice.on_update(visitor.heard(self._fly_to_choice))
        self._files = gui.add_folder("Pictures and videos", expand_by_default=False)
        with self._files:
            self.width = gui.add_number("Width", 1920, min=16, max=LARGEST_SIDE, step=1)
            self.height = gui.add_number("Height", 1080, min=16, max=LARGEST_SIDE, step=1)
            self.shot = gui.add_button("Save a picture", icon=viser.Icon.CAMERA)
            self.count = gui.add_number("Images of the path", 120, min=2, max=MOST_IMAGES, step=1)
            self.film = gui.add_button("Video through the bookmarks", icon=viser.Icon.MOVIE)
            self.shot.on_click(visitor.heard_here(lambda view: visitor.save_picture(view, *self._size())))
            self.film.on_click(visitor.heard(self._save_video))
        self._list()

    # ---- frames ------------------------------------------------------------------------------------------------------

    def _show_frusta(self, shown: bool) -> None:
        if not self._frusta and shown:
            self._draw_frusta()
        for frustum in self._frusta:
            frustum.visible = shown

    def _draw_frusta(self) -> None:
        import viser.transforms as transforms

        scene = self.visitor.scene
        frames = [frame for frame in scene.frames if frame.views]
        held_out = set() if scene.capture is None else {id(frame) for frame in scene.capture.test}
        for number, frame in enumerate(frames[:: max(1, math.ceil(len(frames) / MOST_FRUSTA))]):
            spectrum = next(iter(frame.views))
            view = frame.views[spectrum]
            pose = np.linalg.inv(view.viewmat)
            frustum = self.visitor.client.scene.add_camera_frustum(
                f"/frames/{number:05d}",
                fov=2 * math.atan(view.camera.height / (2 * view.camera.fy)),
                aspect=view.camera.width / view.camera.height,
                scale=0.35 * scene.frame_spacing,
                thickness=1.5,
                thickness_units="screen",
                color=_HELD_OUT if id(frame) in held_out else _LEARNT,
                wxyz=transforms.SO3.from_matrix(pose[:3, :3]).wxyz,
                position=pose[:3, 3],
            )
            frustum.on_click(self.visitor.heard(partial(self._fly, frame)))
            self._frusta.append(frustum)

    def _fly(self, frame: Any) -> None:
        wanted = self.visitor.session.wish.first.spectrum
        self.visitor.fly_to(frame_bookmark(frame, wanted if wanted in frame.views else next(iter(frame.views))))

    # ---- bookmarks ---------------------------------------------------------------------------------------------------

    def _add(self, view: Bookmark) -> None:
        shared = self.visitor.shared
        if len(shared.bookmarks) >= _MOST_BOOKMARKS:
            self.visitor.tell("Not added", f"There are {_MOST_BOOKMARKS:,} bookmarks. Delete one first.")
            return
        taken = {bookmark.name for bookmark in shared.bookmarks}
        name = self.name.value.strip()[:80]
        if not name or name in taken or name == _NONE:
            number = 1 + len(taken)
            while f"view {number}" in taken:
                number += 1
            name = f"view {number}"
        shared.bookmarks.append(replace(view, name=name))
        self.name.value = ""
        self._save_bookmarks()

    def _remove(self) -> None:
        shared, name = self.visitor.shared, self.choice.value
        shared.bookmarks[:] = [bookmark for bookmark in shared.bookmarks if bookmark.name != name]
        self._save_bookmarks()

    def _save_bookmarks(self) -> None:
        try:
            self.visitor.shared.save_bookmarks()
        except UserError as error:
            self.visitor.tell("Bookmarks are not saved", error.message)
        self._list()

    def _list(self) -> None:
        """Show the bookmarks that there are now: another tab may have added some."""
        self.choice.options = (_NONE, *(bookmark.name for bookmark in self.visitor.shared.bookmarks))
        self.choice.value = _NONE

    def _fly_to_choice(self) -> None:
        for bookmark in self.visitor.shared.bookmarks:
            if bookmark.name == self.choice.value:
                self.visitor.fly_to(bookmark)
                return

    # ---- files -------------------------------------------------------------------------------------------------------

    def _size(self) -> tuple[int, int]:
        """The size that is typed [px], shown smaller where pictures may not be so large."""
        self.width.value, self.height.value = fitting(self.width.value, self.height.value)
        return self.width.value, self.height.value

    def _save_video(self) -> None:
        path = path_through(self.visitor.shared.bookmarks, self.count.value)
        self.visitor.errands.begin_long(partial(self._write_video, path, self._size(), self.visitor.session.aside()))

    def _write_video(self, path: list[Bookmark], size: tuple[int, int], session: ViewSession) -> None:
        shared = self.visitor.shared
        with self._files:
            progress = self.visitor.client.gui.add_progress_bar(0.0)

        def images() -> Iterator[Image8]:
            for index, view in enumerate(path):
                yield session.render(view, *size, full=False).picture
                progress.value = 100.0 * (index + 1) / len(path)

        try:
            shared.folder.mkdir(parents=True, exist_ok=True)
            written = write_images(images(), shared.new_file("path"), format="mp4", fps=30)
        finally:
            progress.remove()
        self.visitor.tell("Saved", str(written))
