"""The words of a report, in English and German."""

import re
from collections.abc import Iterable
from typing import Literal

from thermosplat.thermography.certainty import (
    DEPTHS_DIFFER,
    DOUBTS,
    FEW_VIEWS,
    GRAZING,
    NO_SURFACE,
    REFLECTING,
    SMALL,
)

Language = Literal["en", "de"]

FORM = {
    "client": ("Client", "Auftraggeber"),
    "object": ("Object and address", "Objekt und Anschrift"),
    "purpose": ("Purpose", "Zweck"),
    "thermographer": ("Thermographer, qualification", "Thermograf, Qualifikation"),
    "date": ("Date and time of the recording", "Datum und Uhrzeit der Aufnahme"),
    "orientation": ("Orientation of the object", "Ausrichtung des Objekts"),
    "construction": ("Construction and materials", "Bauweise und Baustoffe"),
    "instrument": ("Instrument", "Messgerät"),
    "serial_number": ("Serial number, last calibration", "Seriennummer, letzte Kalibrierung"),
    "lens_and_filter": ("Lens, filter", "Objektiv, Filter"),
    "emissivity": (
        "Emissivity and reflected temperature, how found",
        "Emissionsgrad und reflektierte Temperatur, Quelle",
    ),
    "air_outside": ("Air temperature outside, 24 h before and now", "Außentemperatur, 24 h vorher und jetzt"),
    "air_inside": ("Air temperature inside", "Innentemperatur"),
    "humidity": ("Relative humidity", "Relative Luftfeuchte"),
    "weather": ("Weather and precipitation", "Wetter und Niederschlag"),
    "solar_radiation": ("Solar radiation, 12 h before and now", "Sonneneinstrahlung, 12 h vorher und jetzt"),
    "wind": ("Wind, direction and speed", "Wind, Richtung und Geschwindigkeit"),
    "pressure_difference": ("Pressure difference inside to outside", "Druckdifferenz innen zu außen"),
    "heating": ("Heating or load, before and now", "Beheizung oder Last, vorher und jetzt"),
    "disturbances": ("Other influences", "Weitere Einflüsse"),
    "not_examined": ("Areas not examined", "Nicht untersuchte Bereiche"),
    "further_examination": ("Further examinations", "Weitere Untersuchungen"),
}
"""What a full report after EN 13187 or ISO 6781-1 tells, by names of report.yaml. These are our words, not theirs."""

TEXTS = {
    "report": ("Thermography report", "Thermografiebericht"),
    "overview": ("Overview", "Überblick"),
    "capture": ("Capture", "Aufnahme"),
    "folder": ("Folder", "Ordner"),
    "run": ("Run", "Lauf"),
    "step": (", step ", ", Schritt "),
    "made": ("Report made", "Bericht erstellt"),
    "images": ("Images", "Bilder"),
    "spectrum": ("Evaluated spectrum", "Ausgewertetes Spektrum"),
    "unit": ("Unit", "Einheit"),
    "intensities": (
        "This run has no temperatures: all values are intensities without a unit, and differences are not in kelvin.",
        "Dieser Lauf hat keine Temperaturen: Alle Werte sind Intensitäten ohne Einheit, Differenzen nicht in Kelvin.",
    ),
    "intensity": ("intensity", "Intensität"),
    "scale": ("Metres per world unit", "Meter je Welteinheit"),
    "unknown_scale": ("not known; extents are in world units", "nicht bekannt; Ausdehnungen in Welteinheiten"),
    "position": ("Position on the Earth", "Lage auf der Erde"),
    "reference": ("Reference", "Referenz"),
    "of_surroundings": ("median of its like around it", "Median von Gleichartigem in der Umgebung"),
    "of_area": ("mean of the measurement {}", "Mittelwert der Messung {}"),
    "above": ("Findings lie above it by more than", "Befunde liegen darüber um mehr als"),
    "below": ("Findings lie below it by more than", "Befunde liegen darunter um mehr als"),
    "corrections": ("Corrections applied", "Angewandte Korrekturen"),
    "no_corrections": ("none; values as the capture has them", "keine; Werte wie in der Aufnahme"),
    "findings": ("Findings", "Befunde"),
    "finding": ("Finding", "Befund"),
    "no_findings": ("Nothing lies beyond the limit.", "Nichts liegt jenseits der Grenze."),
    "things": ("Things that have nothing like them around", "Dinge ohne ihresgleichen in der Umgebung"),
    "about_things": (
        "They differ as much from what is around them, but nothing there is the same surface of the same colour: "
        "another material, warmed by the sun or by its use. Compare each with its like.",
        "Sie weichen ebenso von ihrer Umgebung ab, aber nichts dort ist dieselbe Fläche in derselben Farbe: ein "
        "anderes Material, erwärmt von der Sonne oder vom Gebrauch. Vergleichen Sie jedes mit seinesgleichen.",
    ),
    "of_things": ("The most different of", "Die auffälligsten von"),
    "classes": ("Classes of the label images", "Klassen der Label-Bilder"),
    "about_classes": (
        "Numbers of all views that see a class; the area is that of the view that sees the most of it.",
        "Werte aller Ansichten, die eine Klasse zeigen; die Fläche ist die der Ansicht, die am meisten davon zeigt.",
    ),
    "class_name": ("Class", "Klasse"),
    "views": ("Views", "Ansichten"),
    "not_read": (
        "Regions that are not reported, as values there must not be read (glass, bare metal, seen too little)",
        "Bereiche ohne Befund, da Werte dort nicht abgelesen werden dürfen (Glas, blankes Metall, zu wenig gesehen)",
    ),
    "more": ("Further regions that are not listed", "Weitere, nicht aufgeführte Bereiche"),
    "place": ("Place", "Ort"),
    "world": ("Place in the capture's world", "Ort in der Welt der Aufnahme"),
    "enu": ("East, north, up [m]", "Ost, Nord, Höhe [m]"),
    "utm": ("UTM east, north, altitude [m]", "UTM Ost, Nord, Höhe [m]"),
    "area": ("Area", "Fläche"),
    "size": ("Box around it", "Umgebende Box"),
    "world_units": ("world units", "Welteinheiten"),
    "minimum": ("Minimum", "Minimum"),
    "maximum": ("Maximum", "Maximum"),
    "mean": ("Mean", "Mittelwert"),
    "delta": ("ΔT to the reference", "ΔT zur Referenz"),
    "difference": ("Difference to the reference", "Differenz zur Referenz"),
    "doubts": ("To be read with care", "Mit Vorsicht zu lesen"),
    "photograph": ("Nearest photograph", "Nächstes Foto"),
    "thermal_file": ("Thermal file", "Thermische Datei"),
    "severity": ("Severity", "Schwere"),
    "comment": ("Comment", "Bemerkung"),
    "not_given": ("not given", "nicht angegeben"),
    "plan": ("Plan", "Lageplan"),
    "plan_north": ("Seen from above, north is up. Grid:", "Von oben, Norden ist oben. Raster:"),
    "plan_local": ("Seen from above; north is not known. Grid:", "Von oben; Norden ist nicht bekannt. Raster:"),
    "changes": ("Changes since {}", "Veränderungen seit {}"),
    "shift": (
        "All values changed by {}: weather, and the levels of both cameras. That is taken off what follows.",
        "Alle Werte haben sich um {} verändert: Wetter und Pegel beider Kameras. Das ist im Folgenden abgezogen.",
    ),
    "no_changes": (
        "Nothing changed beyond its uncertainty.",
        "Nichts hat sich jenseits der Unsicherheit verändert.",
    ),
    "plan_changes": ("Differences from above, {}", "Differenzen von oben, {}"),
    "change": ("Change", "Veränderung"),
    "change_by": ("Difference", "Differenz"),
    "east_north": ("East, north", "Ost, Nord"),
    "height": ("Height changed by", "Höhe verändert um"),
    **{"warmer": ("warmer", "wärmer"), "colder": ("colder", "kälter"), "gone": ("gone", "fort")},
    **{"new": ("new", "neu"), "moved": ("moved", "bewegt")},
    "measurements": ("Measurements", "Messungen"),
    "no_measurements": ("No measurements were made.", "Es wurden keine Messungen vorgenommen."),
    "name": ("Name", "Name"),
    "shape": ("Shape", "Form"),
    "value": ("Value", "Wert"),
    "extent": ("Extent", "Ausdehnung"),
    "notes": ("Notes", "Anmerkungen"),
    "form": ("Conditions of the examination", "Bedingungen der Untersuchung"),
    "form_source": (
        "Fields as a full report after EN 13187 or ISO 6781-1 has them.",
        "Felder, wie sie ein vollständiger Bericht nach EN 13187 oder ISO 6781-1 hat.",
    ),
    "pv": ("Photovoltaic modules", "Photovoltaikmodule"),
    "irradiance": ("Irradiance on the modules' plane", "Einstrahlung in der Modulebene"),
    "normalised": ("ΔT at 1000 W/m²", "ΔT bei 1000 W/m²"),
    "class": ("Class", "Klasse"),
    "pv_source": (
        "Differences are scaled to 1000 W/m² after IEC TS 62446-3. Its classes: 1 no abnormality, 2 thermal "
        "abnormality, 3 thermal abnormality that is relevant to safety. The examiner chooses the class.",
        "Differenzen sind nach IEC TS 62446-3 auf 1000 W/m² umgerechnet. Ihre Klassen: 1 ohne Auffälligkeit, "
        "2 thermische Auffälligkeit, 3 sicherheitsrelevante thermische Auffälligkeit. Die Klasse wählt der Prüfer.",
    ),
    "pv_low": (
        "The irradiance is below 600 W/m², the least for which such differences are scaled.",
        "Die Einstrahlung liegt unter 600 W/m², dem Mindestwert für eine solche Umrechnung.",
    ),
    "pv_no_degrees": (
        "This run has no temperatures, so no difference is scaled.",
        "Dieser Lauf hat keine Temperaturen, also wird keine Differenz umgerechnet.",
    ),
}

_WORDS = {
    **{"recalculated": "umgerechnet", "emissivity": "Emissionsgrad", "reflected": "reflektiert", "air": "Luft"},
    **{"humidity": "Luftfeuchte", "window": "Fenster", "world units": "Welteinheiten", "std": "Std.-Abw.", "to": "bis"},
    **{"spot": "Punkt", "line": "Linie", "rectangle": "Rechteck", "ellipse": "Ellipse", "polygon": "Polygon"},
    **{"thermal": "Thermisch", "red edge": "Red Edge"},
}
"""What other rooms say of settings, shapes, measurements and spectra."""
_ENGLISH = re.compile(r"\b(" + "|".join(map(re.escape, _WORDS)) + r")\b")
_POINT = re.compile(r"(?<=\d)\.(?=\d)")

_DOUBTS = {
    FEW_VIEWS: "weniger als zwei Aufnahmen zeigen es",
    GRAZING: "nur streifend gesehen",
    REFLECTING: "ändert sich mit der Blickrichtung, wie Spiegelungen",
    DEPTHS_DIFFER: "die Spektren sehen verschiedene Tiefen",
    SMALL: "kleiner als 3x3 Pixel des Sensors",
    NO_SURFACE: "dort ist keine Oberfläche",
}


class Words:
    """The texts of a language.

    Args:
        language: Which.
    """

    def __init__(self, language: Language) -> None:
        self._column = ("en", "de").index(language)
        self.language = language

    def __getitem__(self, name: str) -> str:
        return TEXTS[name][self._column]

    def field(self, name: str) -> str:
        """The label of a field of the form."""
        return FORM[name][self._column]

    def doubt(self, bit: int) -> str:
        """Why a value should not be read: a bit of ``DOUBTS``."""
        return (DOUBTS, _DOUBTS)[self._column][bit]

    def told(self, text: str) -> str:
        """What another room says in English."""
        return text if self.language == "en" else _POINT.sub(",", _ENGLISH.sub(lambda word: _WORDS[word[1]], text))

    def number(self, value: float, decimals: int, *, sign: bool = False) -> str:
        """A number with the language's decimal sign."""
        return self.formatted(value, f"{'+' if sign else ''}.{decimals}f")

    def formatted(self, value: float, form: str) -> str:
        """A number in a form of Python's, with the language's decimal sign."""
        text = format(value, form)
        return text.replace(".", ",") if self.language == "de" else text

    def place(self, numbers: Iterable[float], decimals: int) -> str:
        """Coordinates."""
        return "; ".join(self.number(float(number), decimals) for number in numbers)
