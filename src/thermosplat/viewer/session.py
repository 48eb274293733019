"""One viewer's eyes: what it looks at, the picture it sees, what it measures there. It knows nothing of browsers."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.datasets.frame_tensors import ViewTensors
from thermosplat.errors import UserError
from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.pictures.image_display import Image8
from thermosplat.thermal.radiometry import Palette
from thermosplat.thermography.measurement_book import MeasurementBook
from thermosplat.thermography.measurements import Definition, Measurement, Standpoint, measure, with_unit
from thermosplat.thermography.scene_temperatures import SceneTemperatures
from thermosplat.thermography.shapes import Shape
from thermosplat.viewer.display import Display, compared
from thermosplat.viewer.layers import Layer, LayerImage, LayerRenderer
from thermosplat.viewer.measurements import Mark, Pixel, marked_picture, value_at
from thermosplat.viewer.measuring import Measurer, seen_layer
from thermosplat.viewer.turns import Turns, ViewingEnded
from thermosplat.viewer.wish import Shown, Wish


class Unwanted(Exception):
    """A picture was given up: its viewer wants another one by now."""


@dataclass
class ViewSession:
    """What one viewer looks at.

    Args:
        turns: When it may.
    """

    renderer: LayerRenderer
    turns: Turns
    wish: Wish
    displays: dict[tuple[str, str], Display] = field(default_factory=dict)
    book: MeasurementBook = field(default_factory=MeasurementBook)
    """What was measured; tabs share it."""
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
        other = replace(self, displays=dict(self.displays))
        other.temperatures = self.temperatures
        return other

    # ---- what is seen ------------------------------------------------------------------------------------------------

    def display(self, layer: Layer) -> Display:
        """How a layer is shown; a photograph and an earlier date as the image of their spectrum."""
        return self.displays.get(_key(layer), Display())

    def set_display(self, layer: Layer, **changes: Any) -> None:
        """Change how a layer is shown.

        Args:
            **changes: Fields of ``Display``.
        """
        self.displays[_key(layer)] = replace(self.display(layer), **changes)

    def render(
        self, view: Bookmark, width: int, height: int, *, full: bool = True, unwanted: Callable[[], bool] = bool
    ) -> Shown:
        """Make the picture from a view. Nothing is rendered anew that the last picture from there has.

        Args:
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

    @property
    def measurements(self) -> tuple[Measurement, ...]:
        """What was measured, in this tab or another one."""
        return self.book.pages.measurements

    @property
    def metres_per_unit(self) -> float | None:
        """Length of a world unit [m]: as a measured line says, else as the capture does; None: nobody knows."""
        return self.book.pages.metres_per_unit or self.temperatures.metres_per_unit

    def measure(self, shape: Shape, points: Sequence[Pixel], shown: Shown | None = None) -> Measurement | None:
        """Measure the layer that a picture at rest shows at the first point, and keep the measurement.

        Args:
            points: Its places, in shares of width and height (``shapes.number_of_points``).
            shown: The picture; None: the newest.

        Returns:
            None where there is nothing to measure.

        Raises:
            UserError: There are too many measurements.
        """
        shown = shown or self.shown
        image = None if shown is None or not shown.full else shown.layer_at(points[0][0])
        if shown is None or image is None or image.field is None:
            return None
        width, height = image.size
        places = tuple((min(max(x, 0.0), 1.0) * width, min(max(y, 0.0), 1.0) * height) for x, y in points)
        world = shown.view.in_world(self.renderer.scene.model.placement)
        standpoint = Standpoint(world.viewmat, world.fov_y, width, height, world.name)
        definition = Definition("", shape, image.layer.kind, image.layer.spectrum, standpoint, places)
        depth = Layer("depth", image.layer.spectrum)
        depths = self._rendered([depth], shown.view, width, height)[depth]
        tensors = self._tensors(shown.view, width, height)
        sure = self.turns.run(lambda: self.renderer.how_sure(image.layer, tensors))
        numbers = measure(definition, seen_layer(image, depths, self.temperatures, sure))
        return None if numbers is None else self.book.add(Measurement(definition, numbers))

    def measure_again(self, name: str, **changes: Any) -> None:
        """Give a measurement another alarm or settings of its own, and measure it with them.

        Args:
            **changes: Fields of ``Definition``.

        Raises:
            UserError: There is no such one, or no such layer any more.
        """
        made = self.book.pages.by_name.get(name)
        if made is not None:
            definition = replace(made.definition, **changes)
            numbers = self.turns.run(lambda: Measurer(self.renderer, self.temperatures).measure(definition))
            if numbers is not None:
                self.book.replace(name, Measurement(definition, numbers))

    def renumber(self) -> None:
        """Measure everything again: temperatures are recalculated otherwise than before."""
        measurer, again = Measurer(self.renderer, self.temperatures), []
        for made in self.measurements:
            try:
                numbers = self.turns.run(lambda one=made: measurer.measure(one.definition))  # type: ignore[misc]
            except UserError:  # of a layer that is not there
                continue
            if numbers is not None:
                again.append(Measurement(made.definition, numbers))
        recalculation = self.temperatures.recalculation
        self.book.renumber(again, {} if recalculation is None else recalculation.settings.given)

    def marked(self, shown: Shown) -> Image8:
        """A picture with the marks of the measurements, and its legend."""
        width, height = shown.picture.shape[1], shown.picture.shape[0]
        view = self._tensors(shown.view, width, height)
        viewmat, K = (tensor.cpu().numpy().astype(np.float64) for tensor in (view.viewmat, view.K))
        placement = self.renderer.scene.model.placement

        def places(points: Sequence[Any]) -> list[Pixel] | None:
            if not points or any(point is None for point in points):
                return None
            return _projected(placement.to_scene(np.array(points)), viewmat, K, width, height)

        def place(point: Any) -> Pixel | None:
            found = places([point])
            return None if found is None else found[0]

        marks = []
        for made in self.measurements:
            found, shape = made.numbers, made.definition.shape
            outline = places(found.points)
            if outline is not None:
                ends = (None, None) if shape == "spot" else (place(found.minimum_point), place(found.maximum_point))
                marks.append(Mark(f"{made.name} {made.mean_text}", shape, tuple(outline), *ends))
        return marked_picture(shown.picture, marks, self.legend(shown))

    def legend(self, shown: Shown) -> tuple[Palette, float, float, str] | None:
        """Palette, ends and unit of the first layer that has values; None where all have colours only."""
        for layer in shown.wish.layers[:2]:
            image, display = shown.layers[layer], self.display(layer)
            if image.field is not None or image.quantity not in ("", "features"):
                return display.palette_of(image), *display.range_of(image), image.unit or image.quantity
        return None


def recalculated_text(image: LayerImage, x: float, y: float) -> str:
    """Whether the value under a point is recalculated, for people; "" where none of the picture's is. In the layer of
    how sure values are: whether they may be read."""
    if image.changed is None:
        return ""
    height, width = image.changed.shape
    done = image.changed[min(int(y * height), height - 1), min(int(x * width), width - 1)]
    if image.layer.kind == "doubt":
        return "" if done else " (not to be read)"
    return " (recalculated)" if done else " (not recalculated)"


def _key(layer: Layer) -> tuple[str, str]:
    return ("image" if layer.kind in ("photograph", "before") else layer.kind), layer.spectrum


def _same_view(one: Bookmark, other: Bookmark) -> bool:
    return one.fov_y == other.fov_y and np.array_equal(one.viewmat, other.viewmat)


def _valid(image: LayerImage) -> NDArray[np.bool_]:
    """Where a photograph is, [H, W]."""
    if image.field is not None:
        return np.isfinite(image.field)
    assert image.colors is not None  # noqa: S101  a layer of colours
    return np.any(image.colors > 0, axis=-1)


def _projected(
    points: NDArray[np.float64], viewmat: NDArray[np.floating], K: NDArray[np.floating], w: int, h: int
) -> list[Pixel] | None:
    """Where points of the scene [P, 3] lie in a picture, in shares of its size; None if one lies behind."""
    seen = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    if (seen[:, 2] <= 1e-6).any():
        return None
    pixels = seen @ K.T
    return [(float(x / z / w), float(y / z / h)) for x, y, z in pixels]
