"""Point clouds from PLY files: the positions and colours of the element "vertex", in the order of the file.

The file's size decides how many points are read, never its header alone. Points that are not finite are kept: the
capture leaves them out with a note. Source of the format: Turk 1994, "The PLY Polygon File Format".
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular

_MOST_BYTES = 1 << 31
_LONGEST_HEADER = 1 << 16
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")


class _Unreadable(ValueError):
    """What is wrong, in words that follow the file's name."""


def read_point_cloud(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions [M, 3] [world units] and colours [M, 3] uint8 of a PLY file.

    Args:
        path: The file; text, or binary of either byte order. "vertex" is its first element.

    Raises:
        UserError: The file is damaged, or lacks positions or 8-bit colours.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise _Unreadable(f"it has more than {_MOST_BYTES:,} bytes")
        content = read_regular(path)
        head, body = _divided(content)
        kind, count, fields = _vertices(head)
        rows = _text_rows(body, count, fields) if kind == "ascii" else _binary_rows(body, count, fields, kind)
    except (_Unreadable, OSError) as error:
        raise UserError(
            f"{path} is not a readable point cloud: {error}.", "Expected a PLY with x, y, z, red, green, blue."
        ) from error
    points = np.stack([rows[name] for name in _POSITION], -1).astype(np.float64)
    return points, np.stack([rows[name] for name in _COLOR], -1).astype(np.uint8)


def _divided(content: bytes) -> tuple[list[list[str]], bytes]:
    """The words of the header's lines, and what follows."""
    if not content.startswith(b"ply"):
        raise _Unreadable("it is no PLY file")
    end = content.find(b"end_header", 0, _LONGEST_HEADER)
    newline = content.find(b"\n", end)
    if end < 0 or newline < 0:
        raise _Unreadable("its header has no end")
    lines = content[:end].decode("ascii", "replace").splitlines()
    return [words for line in lines[1:] if (words := line.split())], content[newline + 1 :]


def _vertices(head: list[list[str]]) -> tuple[str, int, list[tuple[str, str]]]:
    """The file's kind, the number of points, and their properties with their types."""
    kind, count = "", -1
    fields: list[tuple[str, str]] = []
    for words in head:
        if words[0] == "format" and len(words) > 1:
            kind = words[1]
        elif words[0] == "element":
            if count >= 0:
                break
            if len(words) != 3 or words[1] != "vertex" or not words[2].isdecimal() or len(words[2]) > 18:
                raise _Unreadable(f"its first element is {' '.join(words[1:])[:60]!r}, not a number of vertices")
            count = int(words[2])
        elif words[0] == "property" and count >= 0:
            if len(words) != 3 or words[1] not in _TYPES:
                raise _Unreadable(f"it has the property {' '.join(words[1:])[:60]!r}, which is not known")
            fields.append((words[2], _TYPES[words[1]]))
    types = dict(fields)
    lacking = [name for name in (*_POSITION, *_COLOR) if name not in types]
    if kind not in _BYTE_ORDERS or lacking or len(types) != len(fields):
        what = f"its points lack {', '.join(lacking)}" if lacking else "its header is no PLY header"
        raise _Unreadable(what)
    if any(types[name] != "u1" for name in _COLOR):
        raise _Unreadable("its colours are not of the type uchar")
    return kind, count, fields


def _binary_rows(body: bytes, count: int, fields: list[tuple[str, str]], kind: str) -> NDArray[np.void]:
    dtype = np.dtype([(name, _BYTE_ORDERS[kind] + letter) for name, letter in fields])
    if count * dtype.itemsize > len(body):
        raise _Unreadable(f"it is too short for its {count:,} points")
    return np.frombuffer(body, dtype, count)


def _text_rows(body: bytes, count: int, fields: list[tuple[str, str]]) -> dict[str, NDArray[np.float64]]:
    words = body.split(maxsplit=min(count * len(fields), len(body)))[: count * len(fields)]
    if len(words) < count * len(fields):
        raise _Unreadable(f"it is too short for its {count:,} points")
    try:
        numbers = np.array(words, dtype="S32").astype(np.float64).reshape(count, len(fields))
    except ValueError as error:
        raise _Unreadable("its points hold what is no number") from error
    columns = {name: numbers[:, place] for place, (name, _) in enumerate(fields)}
    if not all(((columns[name] >= 0) & (columns[name] <= 255)).all() for name in _COLOR):
        raise _Unreadable("its colours are not levels from 0 to 255")
    return columns
