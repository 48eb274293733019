"""Controls of recalculated temperatures: emissivity, what is reflected, air and window, for the whole scene."""

import html
from typing import TYPE_CHECKING, Any

from thermosplat.config.temperature_settings import TemperatureSettings
from thermosplat.spectra import CELSIUS
from thermosplat.thermal.planck_counts import ZERO_CELSIUS

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

_AIR = ("air", "humidity")


class TemperaturePanel:
    """The folder "Temperatures" of the tab "View"; there where something can be recalculated."""

    def __init__(self, visitor: "Visitor") -> None:
        self.visitor = visitor
        made = visitor.session.temperatures.recalculation
        if made is None:
            return
        gui, stated, given = visitor.client.gui, made.stated, made.settings
        air, humidity = stated.air - ZERO_CELSIUS, stated.humidity
        reflected = stated.reflected - ZERO_CELSIUS
        self._begun = {
            "emissivity": stated.emissivity if given.emissivity is None else given.emissivity,
            "reflected": reflected if given.reflected is None else given.reflected,
            "air": air if given.air is None else given.air,
            "humidity": humidity if given.humidity is None else given.humidity,
            "window": stated.window_transmission if given.window is None else given.window,
        }
        begun = {name: round(value, 3) for name, value in self._begun.items()}
        with gui.add_folder("Temperatures", expand_by_default=given.any_given) as self.folder:
            self.on = gui.add_checkbox("Recalculate", given.any_given)
            self.controls = {
                "emissivity": gui.add_number("Emissivity", begun["emissivity"], min=0.01, max=1.0, step=0.01),
                "reflected": gui.add_number("Reflected °C", begun["reflected"], min=-100.0, max=3000.0, step=0.1),
                "air": gui.add_number("Air °C", begun["air"], min=-100.0, max=100.0, step=0.1),
                "humidity": gui.add_number("Humidity", begun["humidity"], min=0.0, max=1.0, step=0.01),
                "window": gui.add_number("Window lets pass", begun["window"], min=0.05, max=1.0, step=0.01),
            }
            self.said = gui.add_html("")
        for control in (self.on, *self.controls.values()):
            control.on_update(visitor.heard(self._apply))
        self._show()

    def show(self, spectrum: str) -> None:
        """Be there for layers of a spectrum that has temperatures alone."""
        if hasattr(self, "folder"):
            self.folder.visible = self.visitor.scene.scales[spectrum].measured_unit == CELSIUS

    def _settings(self) -> TemperatureSettings:
        """What the controls say; air that nobody has spoken of stays out of it until somebody does."""
        made = self.visitor.session.temperatures.recalculation
        if made is None or not self.on.value:
            return TemperatureSettings()
        values: dict[str, Any] = {name: float(control.value) for name, control in self.controls.items()}
        began = {name: round(value, 3) for name, value in self._begun.items()}
        if not made.air_is_known and all(values[name] == began[name] for name in _AIR):
            values = {name: value for name, value in values.items() if name not in _AIR}
        return TemperatureSettings(**values)

    def _apply(self) -> None:
        self.visitor.recalculate(self._settings())
        self._show()

    def _show(self) -> None:
        for control in self.controls.values():
            control.disabled = not self.on.value
        notes = "<br>".join(map(html.escape, self.visitor.session.temperatures.notes))
        self.said.content = f"<div style='padding:0 12px;font-size:12px;opacity:.75'>{notes}</div>"
