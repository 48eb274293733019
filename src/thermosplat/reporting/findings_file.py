"""findings.json beside a report: its findings for programs, and for the page of ``thermosplat-export --format html``.

    {"format": "thermosplat-findings", "version": 1, "spectrum": "thermal", "unit": "°C",
     "findings": [{"name": "1 Window", "text": "mean 31.2 °C, ...", "place": [x, y, z], "mean": 31.2, ...}],
     "things": [{"place": [x, y, z], "mean": 45.0, ...}]}

Things have nothing like them around. Places are in the world of the capture.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular

REPORT_FOLDER, FINDINGS_FILE = "report", "findings.json"
FORMAT, VERSION = "thermosplat-findings", 1
_MOST, _LONGEST = 1000, 2000


@dataclass(frozen=True)
class KnownFinding:
    """A finding of the last report."""

    name: str
    text: str
    place: tuple[float, float, float]
    """In the world."""


def findings_text(spectrum: str, unit: str, findings: list[dict[str, Any]], things: list[dict[str, Any]]) -> str:
    """The file's text.

    Args:
        spectrum: In which they were found.
        unit: Of its values.
        findings: Name, text, place and numbers of each.
        things: Place and numbers of each.
    """
    content = {"format": FORMAT, "version": VERSION, "spectrum": spectrum, "unit": unit}
    return (
        json.dumps(content | {"findings": findings, "things": things}, indent=1, allow_nan=False, ensure_ascii=False)
        + "\n"
    )


def read_findings(run: Path) -> list[KnownFinding]:
    """The findings of a run's last report; none where there was no report.

    Args:
        run: The result folder.

    Raises:
        UserError: The file is something else.
    """
    path = run / REPORT_FOLDER / FINDINGS_FILE
    if not path.exists():
        return []
    try:
        content = json.loads(read_regular(path))
        if (content["format"], content["version"]) != (FORMAT, VERSION):
            raise ValueError("another format")
        return [_finding(one) for one in content["findings"][:_MOST]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f"{path} has no findings that can be read.", "Run thermosplat-report again.") from error


def _finding(stated: Any) -> KnownFinding:
    x, y, z = (float(coordinate) for coordinate in stated["place"])
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError("a place that is none")
    return KnownFinding(str(stated["name"])[:_LONGEST], str(stated["text"])[:_LONGEST], (x, y, z))
