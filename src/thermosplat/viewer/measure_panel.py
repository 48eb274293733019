"""Controls of measuring: a tool for the mouse, the list of what was measured, its marks, and files to save it to."""

import html
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.thermography.measurements import Measurement, profile
from thermosplat.thermography.shapes import MOST_POINTS, Shape
from thermosplat.viewer.measurements import Pixel
from thermosplat.viewer.region_panel import RegionPanel
from thermosplat.viewer.selection_panel import SelectionPanel
from thermosplat.viewer.wish import Shown

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

_TOOLS: dict[str, Shape | None] = {
    "Move": None,
    "Spot": "spot",
    "Line": "line",
    "Rectangle": "rectangle",
    "Ellipse": "ellipse",
    "Polygon": "polygon",
}
_HINTS: dict[Shape | None, str] = {
    None: "**Move.** The mouse moves the camera. The value under the cursor is shown.",
    "spot": "**Spot.** Click a point of the picture.",
    "line": "**Line.** Click both ends.",
    "rectangle": "**Rectangle.** Drag it over the picture.",
    "ellipse": "**Ellipse.** Drag its frame over the picture.",
    "polygon": "**Polygon.** Click its corners, and then Close.",
}
_COLORS: dict[Shape, tuple[int, int, int]] = {
    "spot": (60, 230, 110),
    "line": (255, 210, 60),
    "rectangle": (90, 220, 255),
    "ellipse": (90, 220, 255),
    "polygon": (90, 220, 255),
}
_ALARM, _HOTTEST, _COLDEST = (255, 40, 40), (255, 80, 60), (90, 170, 255)


class MeasurePanel:
    """The tab "Measure"."""

    def __init__(self, visitor: "Visitor") -> None:
        import viser

        self.visitor = visitor
        gui = visitor.client.gui
        self._corners: list[Pixel] = []
        self._corners_of: Shown | None = None
        self._marks: dict[str, tuple[Measurement, list[Any]]] = {}
        self._plot: Any = None
        self.tool = gui.add_button_group("Tool", tuple(_TOOLS))
        self.hint = gui.add_markdown(_HINTS[None])
        self.close = gui.add_button("Close the polygon", visible=False)
        self.table = gui.add_html("")
        self.save = gui.add_button("Save as CSV and PNG", icon=viser.Icon.DEVICE_FLOPPY, disabled=True)
        self.delete = gui.add_button("Delete the last", disabled=True)
        self.undo = gui.add_button("Undo")
        self._profile = gui.add_folder("Along the line", visible=False)
        self.selection = SelectionPanel(visitor)
        self.regions = RegionPanel(visitor)
        self.tool.on_click(visitor.heard(self._take))
        self.close.on_click(visitor.heard(self._close))
        self.save.on_click(visitor.heard_here(self._save))
        self.delete.on_click(visitor.heard(self._delete))
        self.undo.on_click(visitor.heard(self._undo))
        visitor.session.book.heard.append(self._told)
        self._list()

    def leave(self) -> None:
        """The tab was closed: hear of no changes any more."""
        book = self.visitor.session.book
        book.heard[:] = [listener for listener in book.heard if listener != self._told]

    def _told(self) -> None:
        """Something was measured, renamed or deleted, in this tab or another one."""
        self.visitor.errands.add(self._list)

    def _take(self) -> None:
        """Let clicks, or rectangles that are drawn, be measurements of a shape."""
        shape, scene, pointed = _TOOLS[self.tool.value], self.visitor.client.scene, self.visitor.pointed
        scene.remove_click_callback()
        scene.remove_rect_select_callback()
        self._corners = []
        self.hint.content, self.close.visible = _HINTS[shape], False
        if shape in ("rectangle", "ellipse"):
            drawn: Shape = shape
            scene.on_rect_select()(pointed(lambda e, shown: self._measure(drawn, [e.screen_min, e.screen_max], shown)))
        elif shape is not None:
            clicked: Shape = shape
            scene.on_click()(pointed(lambda event, shown: self._clicked(clicked, event.screen_pos, shown)))

    def _clicked(self, shape: Shape, place: Pixel, shown: Shown | None) -> None:
        if shape == "spot":
            self._measure(shape, [place], shown)
            return
        if not self._corners:
            self._corners_of = shown  # a measurement is of one picture
        self._corners.append(place)
        if shape == "line" and len(self._corners) == 2:
            self._finish("line")
        elif shape == "line":
            self.hint.content = "**Line.** Click the other end."
        else:
            self.hint.content = f"**Polygon.** {len(self._corners)} corners."
            self.close.visible = len(self._corners) >= 3
            if len(self._corners) == MOST_POINTS:
                self._finish("polygon")

    def _close(self) -> None:
        if len(self._corners) >= 3:
            self._finish("polygon")

    def _finish(self, shape: Shape) -> None:
        corners, self._corners = self._corners, []
        self.hint.content, self.close.visible = _HINTS[shape], False
        self._measure(shape, corners, self._corners_of)

    def _measure(self, shape: Shape, places: list[Pixel], shown: Shown | None) -> None:
        if not all(certainty.is_known for certainty in self.visitor.scene.certainties.values()):
            self.visitor.tell("One moment", "How sure temperatures are is found once, from the held-out views.")
        made = self.visitor.session.measure(shape, places, shown)
        if made is None or shown is None:
            self.visitor.tell("Nothing to measure there", "Choose a layer of values, and wait until the picture rests.")
            return
        self._list()
        self.selection.choose(made.name)
        image = shown.layer_at(places[0][0])
        if shape == "line" and image is not None and image.field is not None:
            self._draw_profile(made, profile(made.definition, image.field))

    def _list(self) -> None:
        """Show what was measured, and mark it on the scene."""
        book, metres = self.visitor.session.book, self.visitor.session.metres_per_unit
        rows = ""
        for made in book.pages.measurements:
            share = made.numbers.alarm_share
            alarm = f"alarm: {share:.0%} {made.definition.alarm.text}" if made.definition.alarm and share else ""
            below = " · ".join(filter(None, (made.extent_text(metres), alarm)))
            rows += _row(made.name, made.definition.spectrum, made.text, below, "#ff6b5e" if alarm else "")
        for first, second in book.pages.differences:
            if (found := book.pages.difference(first, second)) is not None:
                rows += _row(f"{first} - {second}", "", f"{found[0]:+.2f} {found[1]}")
        self.table.content = (
            f"<table style='width:100%;font-size:12px;padding:0 12px;font-variant-numeric:tabular-nums'>{rows}</table>"
            if rows
            else ""
        )
        self.save.disabled = self.delete.disabled = not rows
        self.selection.show()
        self._mark_all()

    def _mark_all(self) -> None:
        """Put marks on what was measured, and take those off that are no longer right."""
        now = self.visitor.session.book.pages.by_name
        for name in [name for name, (made, _) in self._marks.items() if now.get(name) is not made]:
            for part in reversed(self._marks.pop(name)[1]):
                part.remove()
        for number, (name, made) in enumerate(now.items()):
            if name not in self._marks:
                self._marks[name] = (made, self._marked(made, f"/measured/{number}_{id(made)}"))

    def _marked(self, made: Measurement, node: str) -> list[Any]:
        """Draw a measurement on the object that was measured."""
        world = made.numbers.points
        if not world or any(point is None for point in world):
            return []
        scene, placement = self.visitor.client.scene, self.visitor.scene.model.placement
        points = placement.to_scene(np.array(world))
        shape, alarmed = made.definition.shape, bool(made.numbers.alarm_share)
        standpoint = made.definition.standpoint
        view = Bookmark("", placement.viewmat_to_scene(standpoint.viewmat), standpoint.fov_y)
        if shape == "spot":
            segments = spot_cross(points[0], view)
        else:
            corners = points if shape == "line" else np.concatenate([points, points[:1]])
            segments = np.stack([corners[:-1], corners[1:]], axis=1)
        pieces = [(segments, _ALARM if alarmed else _COLORS[shape])]
        for point, color in ((made.numbers.minimum_point, _COLDEST), (made.numbers.maximum_point, _HOTTEST)):
            if shape != "spot" and point is not None:
                pieces.append((spot_cross(placement.to_scene(np.array(point)), view), color))
        parts = [scene.add_label(node, f"{made.name}  {made.mean_text}", position=points[0], anchor="bottom-left")]
        for number, (lines, color) in enumerate(pieces):
            parts.append(
                scene.add_line_segments(
                    f"{node}/lines{number}",
                    lines - points[0],
                    colors=color,
                    thickness=2.5,
                    thickness_units="screen",
                )
            )
        return parts

    def _draw_profile(self, made: Measurement, values: Any) -> None:
        """The values along a line, as a plot."""
        if self._plot is not None:
            self._plot.remove()
        along = np.linspace(0, 100, len(values))
        self._profile.visible = True
        with self._profile:
            unit = made.numbers.unit or made.numbers.quantity
            self._plot = self.visitor.client.gui.add_uplot(
                (along, np.asarray(values, np.float64)),
                ({"label": "% of the line"}, {"label": unit, "stroke": "#e25822", "width": 2}),
                title=f"{made.name}, {made.definition.spectrum}",
                scales={"x": {"time": False}},
                aspect=1.7,
            )

    def _delete(self) -> None:
        book = self.visitor.session.book
        if book.pages.measurements:
            last = book.pages.measurements[-1]
            book.delete(last.name)
            if last.definition.shape == "line" and self._plot is not None:
                self._plot.remove()
                self._plot, self._profile.visible = None, False
            self._list()

    def _undo(self) -> None:
        if not self.visitor.session.book.undo():
            self.visitor.tell("Nothing to undo")
        self._list()

    def _save(self, view: Bookmark) -> None:
        if self.visitor.session.measurements:
            self.visitor.save_picture(view, *self.visitor.window_size(), with_table=True)


def _row(name: str, what: str, text: str, below: str = "", color: str = "") -> str:
    cell, shade = "padding:2px 8px 2px 0", f";color:{color}" if color else ""
    more = f"<div style='opacity:.75'>{html.escape(below)}</div>" if below else ""
    return (
        f"<tr><td style='{cell};font-weight:600{shade}'>{html.escape(name)}</td>"
        f"<td style='{cell};opacity:.75'>{html.escape(what)}</td>"
        f"<td style='text-align:right'>{html.escape(text)}{more}</td></tr>"
    )


def spot_cross(point: NDArray[np.floating], view: Bookmark) -> NDArray[np.float64]:
    """A cross on a point of the scene, upright in the view in which it was measured.

    Args:
        point: The point, shape [3].

    Returns:
        Two segments in the scene, shape [2, 2, 3]; each is as long as 3% of the picture's height.
    """
    axes, depth = view.viewmat[:2, :3], view.viewmat[2, :3] @ point + view.viewmat[2, 3]
    arms = 0.03 * depth * math.tan(math.radians(view.fov_y) / 2) * axes
    return np.stack([point - arms, point + arms], axis=1)
