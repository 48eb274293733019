"""What is thermally wrong with a scene, as truth.json lists it."""

from typing import Any


class Anomalies:
    """A list that grows while a scene is built."""

    def __init__(self) -> None:
        self.found: list[dict[str, Any]] = []

    def note(self, kind: str, name: str, x: float, y: float, area: float, dT: float, about: str) -> None:
        """Add an anomaly: at x and y [m], of an area [m2], warmer than its surroundings by dT [K]."""
        place = {"x": round(float(x), 2), "y": round(float(y), 2), "area_m2": round(float(area), 2)}
        self.found.append({"kind": kind, "name": name, **place, "dT_K": float(dT), "about": about})
