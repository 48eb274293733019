"""Controls of one measurement: its name, alarm and emissivity, a difference from another one, and the scene's scale."""

from typing import TYPE_CHECKING

from thermosplat.novel_views.bookmarks import Bookmark
from thermosplat.thermography.measurements import WHENS, Alarm, Measurement

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

_NONE, _OFF = "none yet", "off"


class SelectionPanel:
    """The folder "One of them" of the tab "Measure"."""

    def __init__(self, visitor: "Visitor") -> None:
        self.visitor = visitor
        gui, heard = visitor.client.gui, visitor.heard
        with gui.add_folder("One of them", expand_by_default=False, visible=False) as self.folder:
            self.choice = gui.add_dropdown("Which", (_NONE,))
            self.name = gui.add_text("Its name", "")
            self.rename = gui.add_button("Rename")
            self.delete = gui.add_button("Delete this one")
            self.fly = gui.add_button("Fly there")
            self.when = gui.add_dropdown("Alarm", (_OFF, *WHENS))
            self.low = gui.add_number("Limit", 0.0, step=0.1)
            self.high = gui.add_number("Upper limit", 100.0, step=0.1)
            self.own = gui.add_checkbox("Own emissivity", False)
            self.emissivity = gui.add_number("Its emissivity", 0.95, min=0.01, max=1.0, step=0.01)
            self.reflected = gui.add_number("It reflects °C", 20.0, min=-100.0, max=3000.0, step=0.1)
            self.other = gui.add_dropdown("Minus", (_NONE,))
            self.compare = gui.add_button("Add the difference")
            self.metres = gui.add_number("True length [m]", 1.0, min=0.0, max=1e5, step=0.001)
            self.scale = gui.add_button("Set the scene's scale")
        self.choice.on_update(heard(self._fill))
        self.rename.on_click(heard(self._rename))
        self.delete.on_click(heard(self._delete))
        self.fly.on_click(heard(self._fly))
        for control in (self.when, self.low, self.high):
            control.on_update(heard(self._set_alarm))
        for control in (self.own, self.emissivity, self.reflected):
            control.on_update(heard(self._set_emissivity))
        self.compare.on_click(heard(self._compare))
        self.scale.on_click(heard(self._set_scale))

    @property
    def chosen(self) -> Measurement | None:
        """The one that is chosen."""
        return self.visitor.session.book.pages.by_name.get(self.choice.value)

    def choose(self, name: str) -> None:
        """Choose a measurement."""
        if name in self.choice.options:
            self.choice.value = name
            self._fill()

    def show(self) -> None:
        """Show the measurements that there are now."""
        names = tuple(self.visitor.session.book.pages.by_name) or (_NONE,)
        for control in (self.choice, self.other):
            kept = control.value
            if tuple(control.options) != names:
                control.options = names
                control.value = kept if kept in names else names[-1]
        self.folder.visible = names != (_NONE,)
        self._fill()

    def _fill(self) -> None:
        made = self.chosen
        if made is None:
            return
        said, settings = made.definition, made.definition.settings
        self.name.value = said.name
        self.when.value = said.alarm.when if said.alarm is not None else _OFF
        if said.alarm is not None:
            self.low.value = said.alarm.low
            self.high.value = said.alarm.high if said.alarm.when == "between" else self.high.value
        self.low.disabled = said.alarm is None
        self.high.disabled = said.alarm is None or said.alarm.when != "between"
        is_temperature = made.numbers.quantity == "temperature"
        recalculable = is_temperature and self.visitor.session.temperatures.recalculation is not None
        for control in (self.own, self.emissivity, self.reflected):
            control.visible = recalculable
        self.own.value = bool(settings)
        self.emissivity.value = settings.get("emissivity", self.emissivity.value)
        self.reflected.value = settings.get("reflected", self.reflected.value)
        self.emissivity.disabled = self.reflected.disabled = not settings
        self.metres.visible = self.scale.visible = made.numbers.length is not None

    def _rename(self) -> None:
        if (made := self.chosen) is not None:
            new = self.name.value.strip()
            self.visitor.session.book.rename(made.name, new)
            self.show()
            self.choose(new)

    def _delete(self) -> None:
        if (made := self.chosen) is not None:
            self.visitor.session.book.delete(made.name)

    def _fly(self) -> None:
        if (made := self.chosen) is not None:
            view = made.definition.standpoint
            target = Bookmark(made.name, view.viewmat, view.fov_y)
            self.visitor.fly_to(target.in_scene(self.visitor.scene.model.placement))

    def _set_alarm(self) -> None:
        when = next((one for one in WHENS if one == self.when.value), None)
        alarm = None
        if when is not None:
            low, high = float(self.low.value), float(self.high.value)
            alarm = Alarm(when, min(low, high), max(low, high)) if when == "between" else Alarm(when, low)
        self._again(alarm=alarm)

    def _set_emissivity(self) -> None:
        own = {"emissivity": float(self.emissivity.value), "reflected": float(self.reflected.value)}
        self._again(settings=own if self.own.value else {})

    def _again(self, **changes: object) -> None:
        if (made := self.chosen) is not None:
            self.visitor.session.measure_again(made.name, **changes)

    def _compare(self) -> None:
        if (made := self.chosen) is not None:
            self.visitor.session.book.compare(made.name, self.other.value)

    def _set_scale(self) -> None:
        if (made := self.chosen) is not None:
            self.visitor.session.book.set_scale(made.name, float(self.metres.value))
            self.visitor.tell("The scene has a scale", f"{made.name} is {self.metres.value:g} m long.")
