"""Controls of measuring: a tool for the mouse, the list of what was measured, and the files it is saved to."""

import html
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.viewer.measurements import Measurement, Pixel, covered_values
from thermosplat.viewer.session import Shown

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

_TOOLS = {"Move": None, "Spot": "spot", "Line": "line", "Area": "area"}
_HINTS = {
    None: "The mouse moves the camera. The value under the cursor is shown.",
    "spot": "Click a point of the picture.",
    "line": "Click both ends of a line.",
    "area": "Drag a rectangle over the picture.",
}
_COLORS = {"spot": (60, 230, 110), "line": (255, 210, 60), "area": (90, 220, 255)}


class MeasurePanel:
    """The tab "Measure".

    Args:
        visitor: Whose it is.
    """

    def __init__(self, visitor: "Visitor") -> None:
        import viser

        self.visitor = visitor
        gui = visitor.client.gui
        self._first_end: Pixel | None = None
        self._marks: dict[str, list[Any]] = {}
        self._plot: Any = None
        self.tool = gui.add_button_group("Tool", tuple(_TOOLS))
        self.hint = gui.add_markdown(_HINTS[None])
        self.table = gui.add_html("")
        self.save = gui.add_button("Save as CSV and PNG", icon=viser.Icon.DEVICE_FLOPPY, disabled=True)
        self.delete = gui.add_button("Delete the last", disabled=True)
        self._profile = gui.add_folder("Along the line", visible=False)
        self.tool.on_click(visitor.heard(self._take))
        self.save.on_click(visitor.heard_here(self._save))
        self.delete.on_click(visitor.heard(self._delete))

    def _take(self) -> None:
        """Let clicks, or rectangles that are drawn, be measurements of a shape."""
        shape, scene, pointed = _TOOLS[self.tool.value], self.visitor.client.scene, self.visitor.pointed
        scene.remove_click_callback()
        scene.remove_rect_select_callback()
        self._first_end = None
        self.hint.content = _HINTS[shape]
        if shape == "area":
            scene.on_rect_select()(pointed(lambda e, shown: self._measure("area", [e.screen_min, e.screen_max], shown)))
        elif shape is not None:
            scene.on_click()(pointed(lambda event, shown: self._clicked(shape, event.screen_pos, shown)))

    def _clicked(self, shape: str, place: Pixel, shown: Shown | None) -> None:
        if shape == "spot":
            self._measure(shape, [place], shown)
        elif self._first_end is None:
            self._first_end = place
            self.hint.content = "Click the other end."
        else:
            first, self._first_end = self._first_end, None
            self.hint.content = _HINTS["line"]
            self._measure(shape, [first, place], shown)

    def _measure(self, shape: Any, places: list[Pixel], shown: Shown | None) -> None:
        made = self.visitor.session.measure(shape, places, shown)
        if made is None or shown is None:
            self.visitor.tell("Nothing to measure there", "Choose a layer of values, and wait until the picture rests.")
            return
        self._mark(made, shown.view)
        self._list()
        image = shown.layer_at(places[0][0])
        if shape == "line" and image is not None and image.field is not None:
            self._draw_profile(made, covered_values(image.field, "line", places))

    def _mark(self, made: Measurement, view: Bookmark) -> None:
        """Put a mark on the object that was measured."""
        if not made.points:
            return
        scene, name = self.visitor.client.scene, f"/measured/{made.name}"
        points = np.array(made.points)
        if made.shape == "spot":
            segments = spot_cross(points[0], view)
        else:
            corners = points if made.shape == "line" else np.concatenate([points, points[:1]])
            segments = np.stack([corners[:-1], corners[1:]], axis=1)
        self._marks[made.name] = [
            scene.add_label(name, f"{made.name}  {made.mean_text}", position=points[0], anchor="bottom-left"),
            scene.add_line_segments(
                f"{name}/lines",
                segments - points[0],
                colors=_COLORS[made.shape],
                thickness=2.5,
                thickness_units="screen",
            ),
        ]

    def _list(self) -> None:
        rows = "".join(
            f"<tr><td style='padding:2px 8px 2px 0;font-weight:600'>{html.escape(m.name)}</td>"
            f"<td style='padding:2px 8px 2px 0;opacity:.75'>{html.escape(m.layer)}</td>"
            f"<td style='text-align:right'>{html.escape(m.text)}</td></tr>"
            for m in self.visitor.session.measurements
        )
        self.table.content = (
            f"<table style='width:100%;font-size:12px;padding:0 12px;font-variant-numeric:tabular-nums'>{rows}</table>"
            if rows
            else ""
        )
        self.save.disabled = self.delete.disabled = not rows

    def _draw_profile(self, made: Measurement, values: Any) -> None:
        """The values along a line, as a plot."""
        if self._plot is not None:
            self._plot.remove()
        along = np.linspace(0, 100, len(values))
        self._profile.visible = True
        with self._profile:
            self._plot = self.visitor.client.gui.add_uplot(
                (along, np.asarray(values, np.float64)),
                ({"label": "% of the line"}, {"label": made.unit or made.quantity, "stroke": "#e25822", "width": 2}),
                title=f"{made.name}, {made.layer}",
                scales={"x": {"time": False}},
                aspect=1.7,
            )

    def _delete(self) -> None:
        session = self.visitor.session
        if not session.measurements:
            return
        gone = session.measurements.pop()
        for part in reversed(self._marks.pop(gone.name, [])):
            part.remove()
        if gone.shape == "line" and self._plot is not None:
            self._plot.remove()
            self._plot = None
            self._profile.visible = False
        self._list()

    def _save(self, view: Bookmark) -> None:
        if self.visitor.session.measurements:
            self.visitor.save_picture(view, *self.visitor.window_size(), with_table=True)


def spot_cross(point: NDArray[np.floating], view: Bookmark) -> NDArray[np.float64]:
    """A cross on a point of the scene, upright in the view in which it was measured.

    Args:
        point: The point, shape [3].
        view: From where it was measured.

    Returns:
        Two segments in the scene, shape [2, 2, 3]; each is as long as 3% of the picture's height.
    """
    axes, depth = view.viewmat[:2, :3], view.viewmat[2, :3] @ point + view.viewmat[2, 3]
    arms = 0.03 * depth * math.tan(math.radians(view.fov_y) / 2) * axes
    return np.stack([point - arms, point + arms], axis=1)
