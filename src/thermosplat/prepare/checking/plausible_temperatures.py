"""Temperatures that scenes hardly have: a unit that was read as another one."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.capture import View
from thermosplat.spectra import CELSIUS, label
from thermosplat.thermal.radiometry import PixelScale

_COLDEST, _HOTTEST = -60.0, 150.0
"""Between which half of a scene's temperatures lie [°C], as drones, buildings and electronics have them."""
_WARM = 40.0
"""Coldest hundredth of a scene [°C] from which on it is none that people walk in; 104 °F."""
_USUAL = (-25.0, 60.0)
"""Where the middle of a scene lies that a reading in another unit explains [°C]."""
_READINGS = (
    ("kelvin", lambda value: value - 273.15),
    ("°F", lambda value: (value - 32) / 1.8),
    ("ten times the kelvin", lambda value: (value + 273.15) * 10 - 273.15),
    ("tenths of °C", lambda value: value / 10),
    ("tenths of a kelvin", lambda value: (value + 273.15) / 10 - 273.15),
)
"""What values may be if they are not °C, and °C from what was taken for it."""


def temperature_notes(spectrum: str, views: Sequence[View], scale: PixelScale) -> list[str]:
    """Sentences (at most two) on temperatures that are unusual, and on a palette that does not hold them."""
    if scale.unit != CELSIUS or scale.range is None:
        return []
    notes = []
    values = _values(views, scale)
    ends = np.array(scale.range)
    if values is not None and scale.kind == "color" and not ends.min() <= np.median(values) <= ends.max():
        notes.append(
            f"The palette of {label(spectrum)} images goes from {ends[0]:.4g} to {ends[1]:.4g} °C, and half of the "
            f"measured values lie below {np.median(values):.4g} °C: state the palette's ends in °C "
            f"(--{spectrum}.range LOW HIGH)."
        )
    low, middle = (ends.min(), ends.mean()) if values is None else np.percentile(values, [1, 50])
    if _COLDEST <= middle <= _HOTTEST and low < _WARM:
        return notes
    kinds = [name for name, celsius in _READINGS if _USUAL[0] <= celsius(middle) <= _USUAL[1]]
    guess = f" As {kinds[0]} it would be usual." if kinds else ""
    where = "is right for furnaces alone" if middle > 0 else "is colder than any scene"
    notes.append(
        f"Half of the {label(spectrum)} values lie below {middle:,.1f} °C, all but a hundredth above {low:,.1f} °C, "
        f"which {where}.{guess} Is the unit right (--{spectrum}.unit, import --unit)?"
    )
    return notes


def _values(views: Sequence[View], scale: PixelScale) -> NDArray[np.floating] | None:
    """Some of the temperatures; None where images are pseudo-colours alone."""
    found = []
    for view in views:
        pixels = view.pixels()
        if pixels.values is not None:
            found.append(pixels.values[::8, ::8].ravel())
        elif scale.kind == "scalar":
            found.append(np.asarray(scale.value(pixels.image[::8, ::8, 0])).ravel())
    finite = np.concatenate(found) if found else np.empty(0)
    finite = finite[np.isfinite(finite)]
    return finite if len(finite) else None
