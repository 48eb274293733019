"""One viewer's eyes: what it looks at, the picture it sees, what it measures there. It knows nothing of browsers."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.pictures.image_display import Image8
from thermosplat.thermal.radiometry import Palette
from thermosplat.thermography.scene_temperatures import SceneTemperatures
from thermosplat.viewer.display import Comparison, Display, compared
from thermosplat.viewer.layers import Layer, LayerImage, LayerRenderer
from thermosplat.viewer.measurements import Measurement, Pixel, Shape, marked_picture, measure, value_at, with_unit
from thermosplat.viewer.turns import Turns, ViewingEnded

MOST_MEASUREMENTS = 500
"""Of one viewer: more make the page slow."""


@dataclass(frozen=True)
class Wish:
    """What is to be seen; the place to see it from is given apart."""

    first: Layer
    """The layer that is looked at and measured."""
    second: Layer
    """The one that it is compared with."""
    comparison: Comparison = "off"
    """How."""
    share: float = 0.5
    """Of the width that the first layer has in a wipe; of the second layer in a blend."""
    over: bool = False
    """The nearest photograph lies over the picture."""

    @property
    def layers(self) -> list[Layer]:
        """The layers that have to be rendered."""
        shown = [self.first] if self.comparison == "off" else [self.first, self.second]
        return [*shown, Layer("photograph", self.first.spectrum)] if self.over else shown


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture that was made, with the values behind it."""

    wish: Wish
    """What it shows."""
    view: Bookmark
    """From where."""
    layers: dict[Layer, LayerImage]
    """What was rendered for it."""
    picture: Image8
    """8-bit RGB, shape [H, W, 3]."""
    full: bool
    """Whether it is the picture at rest, whose values may be read."""

    def layer_at(self, x: float) -> LayerImage | None:
        """What is seen at a share of the width."""
        wish = self.wish
        if wish.over:
            return self.layers.get(Layer("photograph", wish.first.spectrum))
        return self.layers.get(wish.second if wish.comparison == "wipe" and x > wish.share else wish.first)


class Unwanted(Exception):
    """A picture was given up: its viewer wants another one by now."""


@dataclass
class ViewSession:
    """What one viewer looks at.

    Args:
        renderer: Renders layers of the scene.
        turns: When it may.
        wish: What is seen at first.
    """

    renderer: LayerRenderer
    turns: Turns
    wish: Wish
    displays: dict[tuple[str, str], Display] = field(default_factory=dict)
    measurements: list[Measurement] = field(default_factory=list)
    shown: Shown | None = None
    """The newest picture."""
    gone: threading.Event = field(default_factory=threading.Event)
    """Set when nobody looks any more: what is rendered for this viewer ends."""

    temperatures: SceneTemperatures = field(init=False)
    """How measured values are made, recalculated if the viewer wants that."""

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self.temperatures = self.renderer.scene.temperatures

    def aside(self) -> "ViewSession":
        """A viewer of its own that sees the same, for pictures of other places and sizes; it leaves with this one."""
        other = replace(self, displays=dict(self.displays), measurements=list(self.measurements))
        other.temperatures = self.temperatures
        return other

    # ---- what is seen ------------------------------------------------------------------------------------------------

    def display(self, layer: Layer) -> Display:
        """How a layer is shown; a photograph as the image of its spectrum."""
        return self.displays.get(_key(layer), Display())

    def set_display(self, layer: Layer, **changes: Any) -> None:
        """Change how a layer is shown.

        Args:
            layer: The layer.
            **changes: Fields of ``Display``.
        """
        self.displays[_key(layer)] = replace(self.display(layer), **changes)

    def render(
        self, view: Bookmark, width: int, height: int, *, full: bool = True, unwanted: Callable[[], bool] = bool
    ) -> Shown:
        """Make the picture from a view. Nothing is rendered anew that the last picture from there has.

        Args:
            view: From where.
            width: Of the picture [px].
            height: Of the picture [px].
            full: Also make the values, which are read by ``probe`` and ``measure``.
            unwanted: Whether something else is wanted by now; asked when its turn has come, and when it is made.

        Raises:
            Unwanted: It is.
            ViewingEnded: The model or the viewer is gone.
        """
        wish = self.wish
        values = full or any(self._needs_values(layer) for layer in wish.layers)
        known = self._known(view, width, height, values)
        missing = [layer for layer in wish.layers if layer not in known]
        if missing:
            known |= self._rendered(missing, view, width, height, values, unwanted)
        layers = {layer: known[layer] for layer in wish.layers}
        shown = Shown(wish, view, layers, self._picture(wish, layers), full)
        with self._lock:
            self.shown = shown
        return shown

    def recalculate(self, settings: TemperatureSettings) -> None:
        """Show and measure temperatures with other settings from now on."""
        self.temperatures = self.temperatures.asking(settings)
        self.forget_picture()

    def forget_picture(self) -> None:
        """Render anew next time: the model has changed."""
        with self._lock:
            self.shown = None

    def _rendered(
        self,
        layers: Sequence[Layer],
        view: Bookmark,
        width: int,
        height: int,
        values: bool = True,
        unwanted: Callable[[], bool] = bool,
    ) -> dict[Layer, LayerImage]:
        temperatures = self.temperatures

        def render() -> dict[Layer, LayerImage]:
            if self.gone.is_set():
                raise ViewingEnded
            if unwanted():
                raise Unwanted
            tensors = self._tensors(view, width, height)
            return self.renderer.render(layers, tensors, values=values, temperatures=temperatures)

        rendered = self.turns.run(render)
        if unwanted():
            raise Unwanted
        return rendered

    def _tensors(self, view: Bookmark, width: int, height: int) -> ViewTensors:
        return self.renderer.scene.view(view.viewmat, view.fov_y, width, height)

    def _known(self, view: Bookmark, width: int, height: int, values: bool) -> dict[Layer, LayerImage]:
        """Layers of the last picture, if it was made from there, as large, and with the values that are needed."""
        last = self.shown
        if last is None or not _same_view(last.view, view):
            return {}
        return {
            layer: image
            for layer, image in last.layers.items()
            if image.size == (width, height) and (not values or last.full or image.field is not None)
        }

    def _needs_values(self, layer: Layer) -> bool:
        if layer.kind in ("image", "photograph") and self.temperatures.recalculates(layer.spectrum):
            return True
        return self.display(layer).needs_values(self.renderer.scene.scales[layer.spectrum].palette)

    def _picture(self, wish: Wish, layers: dict[Layer, LayerImage]) -> Image8:
        def shown(layer: Layer) -> Image8:
            return self.display(layer).picture(layers[layer])

        picture = shown(wish.first)
        if wish.comparison != "off":
            picture = compared(picture, shown(wish.second), wish.comparison, wish.share)
        if wish.over:
            over = Layer("photograph", wish.first.spectrum)
            valid = _valid(layers[over])
            picture = np.where(valid[..., None], shown(over), picture // 3).astype(np.uint8)
        return picture

    # ---- what is read and measured -----------------------------------------------------------------------------------

    def probe(self, x: float, y: float) -> tuple[float, str] | None:
        """The value under the cursor, and the text that says it.

        Args:
            x: Share of the picture's width, 0 to 1.
            y: Share of its height.

        Returns:
            None where there is no value, or no picture at rest yet.
        """
        shown = self.shown
        image = None if shown is None else shown.layer_at(x)
        value = None if image is None else value_at(image, x, y)
        if image is None or value is None:
            return None
        what = "" if image.unit or not image.quantity else f"{image.quantity} "
        return value, f"{what}{with_unit(value, image.unit, image.decimals)}{recalculated_text(image, x, y)}"

    def measure(self, shape: Shape, points: Sequence[Pixel], shown: Shown | None = None) -> Measurement | None:
        """Measure the layer that a picture at rest shows at the first point, and keep the measurement.

        Args:
            shape: Of what.
            points: As ``measurements.measure`` takes them.
            shown: The picture; None: the newest.

        Returns:
            None where there is nothing to measure, and of one too many.
        """
        shown = shown or self.shown
        image = None if shown is None or not shown.full else shown.layer_at(points[0][0])
        made = None if image is None else measure(image, shape, points, "")
        if shown is None or made is None:
            return None
        made = replace(made, points=self._scene_points(shown, made), view=shown.view.name)
        letter = {"spot": "S", "line": "L", "area": "A"}[shape]
        with self._lock:  # the number last: another one may have been measured while the depth was rendered
            number = 1 + max((int(m.name[1:]) for m in self.measurements if m.name[0] == letter), default=0)
            made = replace(made, name=f"{letter}{number}")
            if len(self.measurements) >= MOST_MEASUREMENTS:
                return None
            self.measurements.append(made)
        return made

    def _scene_points(self, shown: Shown, made: Measurement) -> tuple[tuple[float, float, float], ...]:
        """Points of the scene under the outline of a measurement; () where one of them sees nothing."""
        size = next(iter(shown.layers.values())).size
        K = self._tensors(shown.view, *size).K.cpu().numpy().astype(np.float64)
        depth_layer = Layer("depth", shown.wish.first.spectrum)
        depth = self._rendered([depth_layer], shown.view, *size)[depth_layer]
        pose = np.linalg.inv(shown.view.viewmat)
        unit = self.renderer.scene.model.placement.unit
        points: list[tuple[float, float, float]] = []
        for x, y in outline(made):
            distance = value_at(depth, x, y)
            if distance is None:
                return ()
            ray = np.linalg.inv(K) @ np.array([x * size[0], y * size[1], 1.0])
            px, py, pz = pose[:3, :3] @ (ray * (distance / unit)) + pose[:3, 3]
            points.append((float(px), float(py), float(pz)))
        return tuple(points)

    def marked(self, shown: Shown) -> Image8:
        """A picture with the marks of the measurements, and its legend."""
        width, height = shown.picture.shape[1], shown.picture.shape[0]
        view = self._tensors(shown.view, width, height)
        viewmat, K = (tensor.cpu().numpy().astype(np.float64) for tensor in (view.viewmat, view.K))
        marks = [
            (made, places)
            for made in self.measurements
            if (places := _projected(made.points, viewmat, K, width, height)) is not None
        ]
        return marked_picture(shown.picture, marks, self.legend(shown))

    def legend(self, shown: Shown) -> tuple[Palette, float, float, str] | None:
        """Palette, ends and unit of the first layer that has values; None where all have colours only."""
        for layer in shown.wish.layers[:2]:
            image, display = shown.layers[layer], self.display(layer)
            if image.field is not None or image.quantity not in ("", "features"):
                return display.palette_of(image), *display.range_of(image), image.unit or image.quantity
        return None


def recalculated_text(image: LayerImage, x: float, y: float) -> str:
    """Whether the value under a point is recalculated, for people; "" where none of the picture's is."""
    if image.changed is None:
        return ""
    height, width = image.changed.shape
    done = image.changed[min(int(y * height), height - 1), min(int(x * width), width - 1)]
    return " (recalculated)" if done else " (not recalculated)"


def outline(made: Measurement) -> list[Pixel]:
    """Corners of a measurement: its points, or the four corners of an area."""
    if made.shape != "area":
        return list(made.points_px)
    (x0, y0), (x1, y1) = made.points_px
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def start_wish(layers: Sequence[Layer]) -> Wish:
    """What is seen first: the first spectrum's image, ready to be compared with the next one's.

    Args:
        layers: Those that there are (``available_layers``).
    """
    return Wish(layers[0], layers[1] if len(layers) > 1 else layers[0])


def layer_labels(layers: Sequence[Layer]) -> dict[str, Layer]:
    """Layers by their names on the page."""
    return {layer.label: layer for layer in layers}


def _key(layer: Layer) -> tuple[str, str]:
    return ("image" if layer.kind == "photograph" else layer.kind), layer.spectrum


def _same_view(one: Bookmark, other: Bookmark) -> bool:
    return one.fov_y == other.fov_y and np.array_equal(one.viewmat, other.viewmat)


def _valid(image: LayerImage) -> NDArray[np.bool_]:
    """Where a photograph is, [H, W]."""
    if image.field is not None:
        return np.isfinite(image.field)
    assert image.colors is not None  # noqa: S101  a layer of colours
    return np.any(image.colors > 0, axis=-1)


def _projected(
    points: Sequence[tuple[float, float, float]], viewmat: NDArray[np.floating], K: NDArray[np.floating], w: int, h: int
) -> list[Pixel] | None:
    """Where points of the scene lie in a picture, in shares of its size; None if one lies behind or there is none."""
    if not points:
        return None
    seen = np.asarray(points) @ viewmat[:3, :3].T + viewmat[:3, 3]
    if (seen[:, 2] <= 1e-6).any():
        return None
    pixels = seen @ K.T
    return [(float(x / z / w), float(y / z / h)) for x, y, z in pixels]
