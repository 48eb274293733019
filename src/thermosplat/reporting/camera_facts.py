"""What the files of a capture say of their instrument and date, as thermosplat-prepare wrote it into its tables."""

import csv
import io
from pathlib import Path

from thermosplat.regular_files import read_regular

TABLE, PAIRS = "frames.csv", "pairs.csv"
_LONGEST = 200


def camera_facts(root: Path, spectrum: str) -> dict[str, str]:
    """Instrument and date of a spectrum's images, by names of ``texts.FORM``; what nobody states is missing.

    Args:
        root: The capture.
        spectrum: The spectrum.
    """
    mine = [row for row in _rows(root / TABLE) if row.get("spectrum") == spectrum]
    times = stated_times(root, spectrum)
    cameras = dict.fromkeys(" ".join(filter(None, (row.get("make"), row.get("model")))).strip() for row in mine)
    days = dict.fromkeys(time[:16].replace("T", " ") for time in (times[:1] + times[-1:]))
    said = {"instrument": ", ".join(filter(None, cameras)), "date": " - ".join(days)}
    return {name: text[:_LONGEST] for name, text in said.items() if text}


def stated_times(root: Path, spectrum: str) -> list[str]:
    """When a spectrum's images were taken, rising, in ISO 8601.

    Where the spectrum's files state no time, as TIFFs of drones do not, the times are those of the images which were
    taken with them.

    Args:
        root: The capture.
        spectrum: The spectrum.
    """
    rows = _rows(root / TABLE)
    pairs = [pair for pair in _rows(root / PAIRS) if pair.get(spectrum)]
    partners = {name for pair in pairs for name in pair.values() if isinstance(name, str)}
    mine = [row for row in rows if row.get("spectrum") == spectrum]
    return _times(mine) or _times([row for row in rows if row.get("file") in partners])


def _rows(path: Path) -> list[dict[str, str]]:
    """Rows of a table; none where it is missing or damaged."""
    try:
        return list(csv.DictReader(io.StringIO(read_regular(path).decode("utf-8-sig"))))
    except (OSError, ValueError, csv.Error):
        return []


def _times(rows: list[dict[str, str]]) -> list[str]:
    return sorted(filter(None, (row.get("time") for row in rows)))
