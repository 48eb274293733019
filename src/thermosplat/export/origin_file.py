"""``geo.json`` beside files whose positions are float32: what is to be added to them far from the world's origin."""

import json
from pathlib import Path

from thermosplat.datasets.placement import Placement
from thermosplat.runs.atomic_writes import write_text

ORIGIN_FILE = "geo.json"
"""Name of the file."""


def write_origin(folder: Path, placement: Placement) -> list[str]:
    """Write the file; nothing where the scene's origin is the world's.

    Args:
        folder: Where the files are that it is about.
        placement: Where the scene lies in the world.

    Returns:
        What to tell people, in one line or none.
    """
    if not placement.is_moved:
        return []
    path = folder / ORIGIN_FILE
    about = "world coordinates, those of the capture's poses = positions in the files of splats here + origin"
    write_text(path, json.dumps({"origin": list(placement.origin), "about": about}, indent=1) + "\n")
    return [f"Splats are stored relative to {origin_text(placement)}, as {path} says: float32 has no digits for more."]


def origin_text(placement: Placement) -> str:
    """The scene's origin in the world, for people and for headers of files."""
    return " ".join(repr(coordinate) for coordinate in placement.origin)
