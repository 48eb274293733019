"""COLMAP models in text, as people and programs write them: made plain, so that pycolmap reads them.

COLMAP cuts names of images at a space, takes every second line of images.txt for points whatever is in it, and knows
neither tabs nor byte-order marks. A plain copy has one space between words and no comments; numbers stand for names.
Points in images and tracks of points, which nothing here looks at, are left out of it.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import cv2  # noqa: F401  before pycolmap, see lens.py
import pycolmap

from thermosplat.datasets.colmap.record_lengths import MODEL_NAMES, Damage

_POSE_FIELDS = 9
"""Numbers before the name in a line of images.txt: id, quaternion, translation, camera."""
_POINT_FIELDS = 7
"""Numbers of a line of points3D.txt that matter: id, position, colour; an error and the track follow."""
_LONGEST_IMAGE_LINE = 8192
"""Characters: a name has 4096 at most (Linux: PATH_MAX)."""


def write_plain(folder: Path, into: Path) -> dict[int, str]:
    """Write the files of a text model as pycolmap reads them.

    Returns:
        The images' names by their numbers; bytes that are not UTF-8 are surrogates.

    Raises:
        Damage: A line is no camera, no image or no point.
    """
    names: dict[int, str] = {}
    _write(into / "cameras.txt", map(_camera, _content(folder / "cameras.txt")))
    _write(into / "images.txt", _images(folder / "images.txt", names))
    _write(into / "points3D.txt", map(_point, _content(folder / "points3D.txt")))
    for name in ("rigs.txt", "frames.txt"):
        if (folder / name).is_file():
            _write(into / name, (" ".join(line.split()) for _, line in _content(folder / name)))
    return names


def _camera(numbered: tuple[int, str]) -> str:
    number, line = numbered
    fields = line.split()
    if found := _wrong_camera(fields):
        raise Damage(f"line {number} of cameras.txt: {found}")
    return " ".join(fields)


def _wrong_camera(fields: list[str]) -> str | None:
    if len(fields) < 4:
        return f"{' '.join(fields)!r} is no camera with model, width, height and parameters"
    number, model, width, height, *params = fields
    if model not in MODEL_NAMES.values():
        return f"camera {number} has the model {model!r}, which COLMAP does not have"
    names = pycolmap.Camera(model=model).params_info
    numbers = [float(param) for param in params if _is_number(param)]
    if len(numbers) == len(params) == len(names.split(",")) and all(map(math.isfinite, numbers)):
        return None
    found = " ".join(params) or "none"
    return f"camera {number} ({model}, {width}x{height}) has the parameters {found}; expected are numbers for {names}"


def _images(path: Path, names: dict[int, str]) -> Iterator[str]:
    """Lines of images, whose names go into a dictionary, with an empty one below each."""
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        *numbers, name = line.split(maxsplit=_POSE_FIELDS)
        if len(numbers) < _POSE_FIELDS or not (numbers[0].isdecimal() and all(map(_is_number, numbers))):
            raise Damage(f"line {number} of images.txt is no image with pose, camera and name: {line[:60]!r}")
        names[int(numbers[0])] = name
        yield f"{' '.join(numbers)} {numbers[0]}\n"
        number, line = next(lines, (number + 1, ""))
        words = line.split() if len(line) < _LONGEST_IMAGE_LINE else []
        if len(words) % 3 or not all(map(_is_number, words)):
            raise Damage(
                f"line {number} of images.txt must have points (x, y, id) or nothing, being the second line of image "
                f"{numbers[0]}, and has {line[:60]!r}: write an empty line below every image without points"
            )


def _point(numbered: tuple[int, str]) -> str:
    number, line = numbered
    fields = line.split(maxsplit=_POINT_FIELDS)[:_POINT_FIELDS]
    if len(fields) < _POINT_FIELDS or not all(map(_is_number, fields)):
        raise Damage(f"line {number} of points3D.txt is no point with id, x, y, z, red, green and blue: {line[:60]!r}")
    return f"{' '.join(fields)} 0"


def _write(path: Path, lines: Iterator[str]) -> None:
    with path.open("w", encoding="utf-8", errors="surrogateescape") as file:
        file.writelines(f"{line}\n" for line in lines)


def _content(path: Path) -> Iterator[tuple[int, str]]:
    return ((number, line) for number, line in _lines(path) if line)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without the blanks around them, comments left out; in UTF-8 or, with its mark, UTF-16."""
    with path.open("rb") as file:
        wide = file.read(2) in (b"\xff\xfe", b"\xfe\xff")
    errors = "replace" if wide else "surrogateescape"
    with path.open(encoding="utf-16" if wide else "utf-8-sig", errors=errors) as file:
        for number, line in enumerate(file, 1):
            if not line.lstrip().startswith("#"):
                yield number, line.strip()


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return "_" not in field
