"""What the files of a capture say of their instrument and date, as thermosplat-prepare wrote it into frames.csv."""

import csv
import io
from pathlib import Path

from thermosplat.regular_files import read_regular

TABLE = "frames.csv"
_LONGEST = 200


def camera_facts(root: Path, spectrum: str) -> dict[str, str]:
    """Instrument and date of a spectrum's images, by names of ``texts.FORM``; what nobody states is missing.

    Args:
        root: The capture.
        spectrum: The spectrum.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read_regular(root / TABLE).decode("utf-8-sig"))))
    except (OSError, ValueError, csv.Error):
        return {}
    mine = [row for row in rows if row.get("spectrum") == spectrum]
    cameras = dict.fromkeys(" ".join(filter(None, (row.get("make"), row.get("model")))).strip() for row in mine)
    times = sorted(filter(None, (row.get("time") for row in mine)))
    days = dict.fromkeys(time[:16].replace("T", " ") for time in (times[:1] + times[-1:]))
    said = {"instrument": ", ".join(filter(None, cameras)), "date": " - ".join(days)}
    return {name: text[:_LONGEST] for name, text in said.items() if text}
