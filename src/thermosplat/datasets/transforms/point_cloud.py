"""Point clouds from PLY files: the positions and colours of the element "vertex", in the order of the file.

The file's size decides how many points are read, never its header alone. Points that are not finite are kept: the
capture leaves them out with a note. Source of the format: Turk 1994, "The PLY Polygon File Format".
"""

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.regular_files import read_regular

_MOST_BYTES = 1 << 31
LONGEST_HEADER = 1 << 16
"""Bytes in which a header has to end."""
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")


class PlyError(ValueError):
    """What is wrong with a PLY, in words that follow the file's name."""


def read_point_cloud(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Positions [M, 3] [world units] and colours [M, 3] uint8 of a PLY file.

    Args:
        path: The file; text, or binary of either byte order. "vertex" is its first element.

    Raises:
        UserError: The file is damaged, or lacks positions or 8-bit colours.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise PlyError(f"it has more than {_MOST_BYTES:,} bytes")
        content = read_regular(path)
        kind, count, fields, start = ply_vertices(content, (*_POSITION, *_COLOR))
        if any(dict(fields)[name] != "u1" for name in _COLOR):
            raise PlyError("its colours are not of the type uchar")
        body = content[start:]
        rows = _text_rows(body, count, fields) if kind == "ascii" else _binary_rows(body, count, fields, kind)
    except (PlyError, OSError) as error:
        raise UserError(
            f"{path} is not a readable point cloud: {error}.", "Expected a PLY with x, y, z, red, green, blue."
        ) from error
    points = np.stack([rows[name] for name in _POSITION], -1).astype(np.float64)
    return points, np.stack([rows[name] for name in _COLOR], -1).astype(np.uint8)


def ply_vertices(content: bytes, needed: Collection[str]) -> tuple[str, int, list[tuple[str, str]], int]:
    """What the header of a PLY says of its first element, the vertices.

    Args:
        content: The file, or its first ``LONGEST_HEADER`` bytes.
        needed: Properties that they must have.

    Returns:
        The file's kind, one of ``BYTE_ORDERS``; the number of vertices; names and types of their properties, as NumPy
        has them without an order; and where the vertices begin [bytes].

    Raises:
        PlyError: It is no such header.
    """
    if not content.startswith(b"ply"):
        raise PlyError("it is no PLY file")
    end = content.find(b"end_header", 0, LONGEST_HEADER)
    newline = content.find(b"\n", end)
    if end < 0 or newline < 0:
        raise PlyError("its header has no end")
    kind, count = "", -1
    fields: list[tuple[str, str]] = []
    for line in content[:end].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", named, *_]:
                kind = named
            case ["element", *_] if count >= 0:
                break
            case ["element", "vertex", number] if number.isdecimal() and len(number) <= 18:
                count = int(number)
            case ["element", *words]:
                raise PlyError(f"its first element is {' '.join(words)[:60]!r}, not a number of vertices")
            case ["property", named, name] if count >= 0 and named in _TYPES:
                fields.append((name, _TYPES[named]))
            case ["property", *words] if count >= 0:
                raise PlyError(f"it has the property {' '.join(words)[:60]!r}, which is not known")
    names = [name for name, _ in fields]
    if lacking := [name for name in needed if name not in names]:
        raise PlyError(f"its points lack {', '.join(lacking)}")
    if kind not in BYTE_ORDERS or len(set(names)) != len(names):
        raise PlyError("its header is no PLY header")
    return kind, count, fields, newline + 1


def _binary_rows(body: bytes, count: int, fields: list[tuple[str, str]], kind: str) -> NDArray[np.void]:
    dtype = np.dtype([(name, BYTE_ORDERS[kind] + letter) for name, letter in fields])
    if count * dtype.itemsize > len(body):
        raise PlyError(f"it is too short for its {count:,} points")
    return np.frombuffer(body, dtype, count)


def _text_rows(body: bytes, count: int, fields: list[tuple[str, str]]) -> dict[str, NDArray[np.float64]]:
    words = body.split(maxsplit=min(count * len(fields), len(body)))[: count * len(fields)]
    if len(words) < count * len(fields):
        raise PlyError(f"it is too short for its {count:,} points")
    try:
        numbers = np.array(words, dtype="S32").astype(np.float64).reshape(count, len(fields))
    except ValueError as error:
        raise PlyError("its points hold what is no number") from error
    columns = {name: numbers[:, place] for place, (name, _) in enumerate(fields)}
    if not all(((columns[name] >= 0) & (columns[name] <= 255)).all() for name in _COLOR):
        raise PlyError("its colours are not levels from 0 to 255")
    return columns
