"""Controls of regions beyond a threshold in the whole scene: a list to fly along."""

from typing import TYPE_CHECKING

from thermosplat.thermography.hot_regions import Region
from thermosplat.viewer.measuring import Measurer
from thermosplat.viewer.viewed_scene import frame_bookmark

if TYPE_CHECKING:
    from thermosplat.viewer.visitor import Visitor

_NONE = "none yet"
_MOST = 100
"""Regions that are listed."""


class RegionPanel:
    """The folder "Regions" of the tab "Measure"; there where views of the capture measure something."""

    def __init__(self, visitor: "Visitor") -> None:
        self.visitor = visitor
        self.found: list[tuple[Region, str]] = []
        gui, scene = visitor.client.gui, visitor.scene
        measured = any(scale.measured_unit is not None for scale in scene.scales.values())
        with gui.add_folder("Regions", expand_by_default=False, visible=measured and bool(scene.frames)):
            self.colder = gui.add_dropdown("Which are", ("above", "below"))
            self.threshold = gui.add_number("Threshold", 30.0, step=0.1)
            self.find = gui.add_button("Find them in the whole scene")
            self.choice = gui.add_dropdown("Fly to region", (_NONE,))
        self.find.on_click(visitor.heard(lambda: visitor.errands.begin_long(self._find)))
        self.choice.on_update(visitor.heard(self._fly))

    def _find(self) -> None:
        session, scene = self.visitor.session, self.visitor.scene
        measurer = Measurer(session.renderer, session.temperatures)
        spectrum, colder = measurer.measured_spectrum(), self.colder.value == "below"
        self.found = session.turns.run(lambda: measurer.regions(spectrum, float(self.threshold.value), colder=colder))[
            :_MOST
        ]
        unit = "°C" if scene.scales[spectrum].measured_unit == "celsius" else ""
        self.choice.options = (_NONE, *(self._text(k, one, unit) for k, (one, _) in enumerate(self.found, 1)))
        self.choice.value = _NONE
        self.visitor.tell("Regions", f"{len(self.found)} found.")

    def _text(self, number: int, region: Region, unit: str) -> str:
        metres = self.visitor.session.metres_per_unit
        area = f"{region.area * (metres or 1) ** 2:.2g} {'m²' if metres else 'units²'}"
        return f"{number}: {region.extreme:.1f} {unit}, {area}, {region.views} views"

    def _fly(self) -> None:
        if self.choice.value == _NONE:
            return
        _, name = self.found[int(self.choice.value.split(":")[0]) - 1]
        spectrum = Measurer(self.visitor.session.renderer).measured_spectrum()
        frame = next(frame for frame in self.visitor.scene.frames if frame.name == name)
        self.visitor.fly_to(frame_bookmark(frame, spectrum))
