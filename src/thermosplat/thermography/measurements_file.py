"""x"""

from pathlib import Path

MEASUREMENTS = "measurements.json"


def read_scale(path: Path) -> float | None:
    """x"""
    return None
