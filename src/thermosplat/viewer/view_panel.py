"""Controls of what is seen: layers, their comparison, palette and range, isotherms and threshold."""

from typing import TYPE_CHECKING, Any

from thermosplat.pictures.display_palettes import DISPLAY_PALETTES
from thermosplat.viewer.display import OWN_PALETTE, picture_range
from thermosplat.viewer.layers import Layer, available_layers
from thermosplat.viewer.temperature_panel import TemperaturePanel
from thermosplat.viewer.wish import layer_labels

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

_RANGES = {"the capture's": "capture", "of the picture": "automatic", "locked": "locked"}
_COMPARISONS = {"one": "off", "wipe": "wipe", "blend": "blend"}
_SIZES = {"full": 1.0, "half": 0.5, "a third": 1 / 3}


class ViewPanel:
    """The tab "View"."""

    def __init__(self, visitor: "Visitor") -> None:
        self.visitor = visitor
        self.layers = layer_labels(available_layers(visitor.scene))
        gui, names = visitor.client.gui, tuple(self.layers)
        wish = visitor.session.wish
        self.first = gui.add_dropdown("Layer", names, initial_value=wish.first.label)
        self.comparison = gui.add_button_group("Show", tuple(_COMPARISONS))
        self.second = gui.add_dropdown("Beside it", names, initial_value=wish.second.label, visible=False)
        self.share = gui.add_slider("Share", 0.0, 1.0, 0.01, wish.share, visible=False)
        with gui.add_folder("Values") as self.values:
            self.palette = gui.add_dropdown("Palette", (OWN_PALETTE, *DISPLAY_PALETTES))
            self.range = gui.add_dropdown("Range", tuple(_RANGES))
            self.low = gui.add_number("Lowest", 0.0, step=0.01)
            self.high = gui.add_number("Highest", 1.0, step=0.01)
            self.isotherms = gui.add_number("Isotherms every", 0.0, min=0.0, step=0.01, hint="0: none")
            self.threshold = gui.add_checkbox("Only values between", False)
            self.least = gui.add_number("From", 0.0, step=0.01)
            self.most = gui.add_number("To", 1.0, step=0.01)
        self.temperatures = TemperaturePanel(visitor)
        self.size = gui.add_dropdown(
            "At rest", tuple(_SIZES), hint="Size of the picture when the camera rests, of the window's"
        )
        self._fill()
        self._listen()

    @property
    def layer(self) -> Layer:
        """The layer whose values are set up here: the first, or the other one where that has colours only."""
        wish = self.visitor.session.wish
        if self._has_values(wish.first) or wish.comparison == "off":
            return wish.first
        return wish.second

    def _has_values(self, layer: Layer) -> bool:
        has_palette = self.visitor.scene.scales[layer.spectrum].has_intensity
        return layer.kind != "features" and (layer.kind not in ("image", "photograph", "before") or has_palette)

    def show_share(self, share: float) -> None:
        """Show a share that was set elsewhere."""
        self.share.value = share

    def show_range(self) -> None:
        """Show the values at the palette's ends in the picture that was just made."""
        display = self.visitor.session.display(self.layer)
        if display.range_mode == "locked" or not self._has_values(self.layer):
            return
        low, high = self._present_range()
        self.low.value, self.high.value = round(low, 3), round(high, 3)
        if display.threshold is None:
            self.least.value, self.most.value = self.low.value, self.high.value

    def _listen(self) -> None:
        heard = self.visitor.heard
        self.first.on_update(heard(lambda: self._choose(first=self.layers[self.first.value])))
        self.second.on_update(heard(lambda: self._choose(second=self.layers[self.second.value])))
        self.comparison.on_click(heard(self._compare))
        self.share.on_update(heard(lambda: self.visitor.wish(share=self.share.value)))
        self.size.on_update(heard(self._resize))
        self.range.on_update(heard(self._choose_range))
        for control in (self.palette, self.low, self.high, self.isotherms, self.threshold, self.least, self.most):
            control.on_update(heard(self._apply))

    def _choose(self, **changes: Layer) -> None:
        before = self.visitor.session.wish
        if changes.get("first") == before.second:  # two layers are compared, never one with itself
            changes["second"] = before.first
        elif changes.get("second") == before.first:
            changes["first"] = before.second
        self.visitor.wish(**changes)
        wish = self.visitor.session.wish
        self.first.value, self.second.value = wish.first.label, wish.second.label
        self._fill()

    def _compare(self) -> None:
        how = _COMPARISONS[self.comparison.value]
        self.second.visible = self.share.visible = how != "off"
        self.visitor.wish(comparison=how)
        self._fill()

    def _resize(self) -> None:
        self.visitor.at_rest = _SIZES[self.size.value]
        self.visitor.wake()

    def _choose_range(self) -> None:
        if _RANGES[self.range.value] == "locked":  # what is seen now is what is locked
            low, high = self._present_range()
            self.low.value, self.high.value = round(low, 3), round(high, 3)
        self._apply()

    def _present_range(self) -> tuple[float, float]:
        session, shown = self.visitor.session, self.visitor.session.shown
        image = None if shown is None else shown.layers.get(self.layer)
        if image is None:
            return self.low.value, self.high.value
        return session.display(self.layer).range_of(image)

    def _apply(self) -> None:
        """From the controls to the display of the layer."""
        mode = _RANGES[self.range.value]
        self.low.disabled = self.high.disabled = mode != "locked"
        self.least.disabled = self.most.disabled = not self.threshold.value
        self.visitor.session.set_display(
            self.layer,
            palette=self.palette.value,
            range_mode=mode,
            locked=(float(self.low.value), float(self.high.value)),
            isotherms=max(0.0, float(self.isotherms.value)),
            threshold=(float(self.least.value), float(self.most.value)) if self.threshold.value else None,
        )
        self.visitor.wake()

    def _fill(self) -> None:
        """From the display of the layer to the controls."""
        display = self.visitor.session.display(self.layer)
        self.values.visible = self._has_values(self.layer)
        self.temperatures.show(self.layer.spectrum)
        low, high = display.locked
        if display.range_mode != "locked":
            low, high = self._natural_range()
        words: dict[Any, Any] = {mode: word for word, mode in _RANGES.items()}
        self.palette.value, self.range.value = display.palette, words[display.range_mode]
        self.low.value, self.high.value = round(low, 3), round(high, 3)
        self.isotherms.value = display.isotherms
        self.threshold.value = display.threshold is not None
        self.least.value, self.most.value = display.threshold or (round(low, 3), round(high, 3))
        self.low.disabled = self.high.disabled = display.range_mode != "locked"
        self.least.disabled = self.most.disabled = display.threshold is None

    def _natural_range(self) -> tuple[float, float]:
        scale = self.visitor.scene.scales[self.layer.spectrum]
        if self.layer.kind in ("image", "photograph") and scale.measured_unit is not None and scale.range is not None:
            return scale.range
        shown = self.visitor.session.shown
        image = None if shown is None else shown.layers.get(self.layer)
        return picture_range(None if image is None else image.field)
