"""report.yaml of a run: what people say of it. It is written once, and never changed by a command after that.

A finding is recognised by its place: it has the entry whose place is nearest, within half a metre, or within the
extent of the finding. The order of the entries is that of the report; findings without an entry come after them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from thermosplat.config.values import shortened
from thermosplat.config.yaml_files import read_yaml
from thermosplat.errors import UserError
from thermosplat.printing import printable
from thermosplat.regular_files import read_regular
from thermosplat.reporting.findings import Finding
from thermosplat.reporting.texts import FORM
from thermosplat.runs.atomic_writes import write_text

REPORT_FILE = "report.yaml"
_SAYS = ("title", "severity", "class", "comment")
_ENTRY = ("place", *_SAYS, "leave_out")
_NEAR = 0.5
"""[m] within which a finding is the one of an entry: the accuracy that places of flights are asked for."""
_LONGEST = 5000
_HEAD = """\
# What the report says beside the measured numbers. thermosplat-report has written this file once, reads it each time,
# and does not change it. Empty fields are printed as "not given". Delete the file to begin anew.
"""
_FINDINGS_HEAD = """
# Findings, in the order of the report; "place" tells which is which. "leave_out: true" takes one out of the report.
# "class" is one of IEC TS 62446-3: 1, 2 or 3.
"""


@dataclass(frozen=True)
class Entry:
    """What people say of a finding."""

    place: tuple[float, float, float]
    """Where it is, in the world."""
    title: str = ""
    severity: str = ""
    of_class: str = ""
    """After IEC TS 62446-3."""
    comment: str = ""
    leave_out: bool = False


@dataclass(frozen=True)
class ReportFile:
    """What report.yaml says."""

    title: str = ""
    notes: str = ""
    form: dict[str, str] = field(default_factory=dict)
    """By names of ``texts.FORM``; "" where nothing is given."""
    irradiance: float | None = None
    """On the modules' plane [W/m²]; None: there is no page for photovoltaics."""
    findings: tuple[Entry, ...] = ()

    def ordered(
        self, found: Sequence[Finding], metres_per_unit: float | None
    ) -> tuple[list[tuple[Finding, Entry]], int]:
        """Findings in the order of the report with what is said of each, and how many have no entry.

        Args:
            found: As they were found.
            metres_per_unit: Length of a world unit [m]; None: nobody knows it.
        """
        near = _NEAR / metres_per_unit if metres_per_unit else 0.0
        pairs = sorted(
            (distance, number, index)
            for number, one in enumerate(found)
            for index, entry in enumerate(self.findings)
            if (distance := math.dist(one.region.place, entry.place))
            <= max(near, float(np.linalg.norm(one.region.size)))
        )
        entry_of: dict[int, int] = {}
        for _, number, index in pairs:
            if number not in entry_of and index not in entry_of.values():
                entry_of[number] = index
        known = sorted(entry_of, key=lambda number: entry_of[number])
        listed = [(found[number], self.findings[entry_of[number]]) for number in known]
        fresh = [(one, Entry(one.region.place)) for number, one in enumerate(found) if number not in entry_of]
        return [pair for pair in (*listed, *fresh) if not pair[1].leave_out], len(fresh)


def write_first(path: Path, findings: Sequence[Finding], known: dict[str, str]) -> None:
    """Write report.yaml with empty fields for people to fill in.

    Args:
        path: The file.
        findings: An entry each.
        known: Fields of the form that the capture tells.
    """
    lines = [_HEAD + 'title: ""', 'notes: ""', "form:"]
    lines += [f"  {name}: {_quoted(known.get(name, ''))}  # {texts[0]}" for name, texts in FORM.items()]
    lines += ["photovoltaics:", '  irradiance: ""  # W/m² on the plane of the modules; a number adds a page']
    lines += [_FINDINGS_HEAD + ("findings:" if findings else "findings: []")]
    for one in findings:
        place = ", ".join(f"{x:.4f}" for x in one.region.place)
        lines += [f"  - place: [{place}]", *(f'    {name}: ""' for name in _SAYS), "    leave_out: false"]
    write_text(path, "\n".join(lines) + "\n")


def read_report(path: Path) -> ReportFile:
    """What report.yaml says.

    Args:
        path: The file.

    Raises:
        UserError: It cannot be read, or has something unknown or impossible.
    """
    try:
        read_regular(path)  # a pipe would never end
    except OSError as error:
        raise UserError(f"Cannot read {path}: {error.strerror or error}.", _hint(path)) from error
    content = read_yaml(path)
    _known(content, ("title", "notes", "form", "photovoltaics", "findings"), path)
    form, solar, entries = content.get("form") or {}, content.get("photovoltaics") or {}, content.get("findings") or []
    if not (isinstance(form, dict) and isinstance(solar, dict) and isinstance(entries, list)):
        raise UserError(f"{path}: form and photovoltaics must hold keys and values, and findings a list.", _hint(path))
    _known(form, tuple(FORM), path, "form.")
    _known(solar, ("irradiance",), path, "photovoltaics.")
    return ReportFile(
        title=_text(content.get("title"), path, "title"),
        notes=_text(content.get("notes"), path, "notes"),
        form={name: _text(form.get(name), path, name) for name in FORM},
        irradiance=_irradiance(solar.get("irradiance"), path),
        findings=tuple(_entry(one, number, path) for number, one in enumerate(entries, 1)),
    )


def _entry(stated: Any, number: int, path: Path) -> Entry:
    where = f"findings, entry {number}"
    if not isinstance(stated, dict):
        raise UserError(f"{path}: {where} must hold keys and values.", _hint(path))
    _known(stated, _ENTRY, path, f"{where}: ")
    place = stated.get("place")
    if not (isinstance(place, list) and len(place) == 3 and all(map(_is_number, place))):
        raise UserError(f"{path}: {where} needs a place of three numbers.", _hint(path))
    left_out = stated.get("leave_out", False)
    if not isinstance(left_out, bool):
        raise UserError(f"{path}: leave_out of {where} must be true or false.", _hint(path))
    title, severity, of_class, comment = (_text(stated.get(name), path, name) for name in _SAYS)
    x, y, z = map(float, place)
    return Entry((x, y, z), title, severity, of_class, comment, left_out)


def _irradiance(stated: Any, path: Path) -> float | None:
    if stated in (None, ""):
        return None
    try:
        value = float(stated)
    except (TypeError, ValueError):
        value = math.nan
    if isinstance(stated, bool) or not 0 < value <= 2000:
        raise UserError(f"{path}: photovoltaics.irradiance must be a number of W/m² from 1 to 2000.", _hint(path))
    return value


def _text(stated: Any, path: Path, name: str) -> str:
    if isinstance(stated, dict | list) or len(str(stated)) > _LONGEST:
        raise UserError(f"{path}: {name} must be a text of at most {_LONGEST} letters.", _hint(path))
    return "" if stated is None else str(stated).strip()


def _known(stated: dict[Any, Any], names: Sequence[str], path: Path, where: str = "") -> None:
    if unknown := [str(name) for name in stated if name not in names]:
        raise UserError(f"{path}: {where}{shortened(unknown[0])} is unknown.", f"Known are {', '.join(names)}.")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _quoted(text: str) -> str:
    """A text as YAML reads it back; ``${`` is not expanded there, and so is refused."""
    clean = printable(text).replace("${", "$ {")
    return yaml.safe_dump(clean, default_style='"', width=math.inf).strip()


def _hint(path: Path) -> str:
    return f"Mend it, or delete {path.name} and run thermosplat-report again."
