"""What is wrong with the files of a COLMAP model, in words: pycolmap names its own source lines instead."""

import math
from collections.abc import Iterator
from pathlib import Path

import cv2  # noqa: F401  before pycolmap, see lens.py
import pycolmap

from thermosplat.datasets.colmap.record_lengths import MODEL_NAMES, wrong_lengths

_NEEDED = ("cameras", "images", "points3D")
_RIG = ("rigs", "frames")
_POSE_FIELDS = 9
"""Numbers before the name in a line of images.txt: id, quaternion, translation, camera."""


def damage_before_reading(folder: Path) -> str | None:
    """Missing files, and binary files that their records do not fill: on some pycolmap hangs or takes all memory."""
    return _special(folder) or _missing(folder) or wrong_lengths(folder)


def damage_after_failure(folder: Path, error: Exception) -> str:
    """The first line that is wrong in a text model that pycolmap could not read, else pycolmap's reason.

    Args:
        folder: The model's folder.
        error: What pycolmap raised.
    """
    binary = all((folder / f"{name}.bin").is_file() for name in _NEEDED)
    found = None if binary else _wrong_text(folder)
    return found or " ".join(str(error).rpartition("] ")[2].split()).rstrip(".") or type(error).__name__


def _special(folder: Path) -> str | None:
    """A name of the model's files under which something else lies, such as a pipe, which is read for ever."""
    files = (f"{name}.{kind}" for name in (*_NEEDED, *_RIG) for kind in ("bin", "txt"))
    return next((f"{file} is no file" for file in files if (folder / file).exists() != (folder / file).is_file()), None)


def _missing(folder: Path) -> str | None:
    kinds = {kind: [name for name in _NEEDED if not (folder / f"{name}.{kind}").is_file()] for kind in ("bin", "txt")}
    kind = min(kinds, key=lambda kind: len(kinds[kind]))
    lacking = kinds[kind]
    if not lacking:  # a rig is in two files or, before COLMAP 3.12, in none
        rig = [name for name in _RIG if not (folder / f"{name}.{kind}").is_file()]
        lacking = rig if len(rig) == 1 else []
    if not lacking:
        return None
    there = ", ".join(sorted(path.name for path in folder.iterdir() if path.suffix == f".{kind}"))
    names = " and ".join(f"{name}.{kind}" for name in lacking)
    return f"{names} {'is' if len(lacking) == 1 else 'are'} missing beside {there}"


def _wrong_text(folder: Path) -> str | None:
    for number, line in _lines(folder / "cameras.txt"):
        if found := _wrong_camera(line.split()):
            return f"line {number} of cameras.txt: {found}"
    lines = _lines(folder / "images.txt", points=True)
    for number, line in lines:
        fields = line.split()
        if len(fields) <= _POSE_FIELDS or not all(_is_number(field) for field in fields[:_POSE_FIELDS]):
            return f"line {number} of images.txt is no image with pose, camera and name: {line[:60]!r}"
    return None


def _wrong_camera(fields: list[str]) -> str | None:
    if len(fields) < 4:
        return f"{' '.join(fields)!r} is no camera with model, width, height and parameters"
    number, model, width, height, *params = fields
    if model not in MODEL_NAMES.values():
        return f"camera {number} has the model {model!r}, which COLMAP does not have"
    names = pycolmap.Camera(model=model).params_info
    if len(params) == len(names.split(",")) and all(_is_number(param) for param in params):
        return None
    found = " ".join(params) or "none"
    return f"camera {number} ({model}, {width}x{height}) has the parameters {found}; expected are numbers for {names}"


def _lines(path: Path, *, points: bool = False) -> Iterator[tuple[int, str]]:
    """Numbered lines that are no comments; with `points` a line of points follows each, which is left out."""
    numbered = iter(enumerate(path.read_text(errors="replace").splitlines(), 1))
    for number, line in numbered:
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.strip()
            if points:
                next(numbered, None)


def _is_number(field: str) -> bool:
    try:
        return math.isfinite(float(field))
    except ValueError:
        return False
