"""Points and meshes as binary PLY with any properties: what CloudCompare, MeshLab and Blender open."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermosplat.export.formats.ply import comment_lines
from thermosplat.runs.atomic_writes import write_bytes

_TYPES = {np.dtype("<f4"): "float", np.dtype("<f8"): "double", np.dtype("u1"): "uchar"}


def write_points(
    path: Path,
    points: NDArray[np.floating],
    colors: NDArray[np.uint8],
    scalars: Mapping[str, NDArray[np.float32]],
    comments: Iterable[str] = (),
    *,
    faces: NDArray[np.int32] | None = None,
) -> None:
    """Write coloured points with scalars, or the mesh that they are the vertices of.

    Args:
        path: The file, ``*.ply``.
        points: Positions [world units], [M, 3]; written in their own type, float32 or float64.
        colors: 8-bit RGB, [M, 3].
        scalars: Values of each point by name, [M] each; CloudCompare wants names that begin with "scalar_".
        faces: Triangles as indices of points, [F, 3]; None: points alone.
    """
    columns: dict[str, NDArray[np.generic]] = {name: points[:, i] for i, name in enumerate("xyz")}
    columns |= {name: colors[:, i] for i, name in enumerate(("red", "green", "blue"))}
    columns |= dict(scalars)
    kinds = {name: values.dtype.newbyteorder("<") for name, values in columns.items()}
    table = np.empty(len(points), np.dtype(list(kinds.items())))
    for name, values in columns.items():
        table[name] = values
    header = ["ply", "format binary_little_endian 1.0", *comment_lines(comments), f"element vertex {len(points)}"]
    header += [f"property {_TYPES[kind]} {name}" for name, kind in kinds.items()]
    content = table.tobytes()
    if faces is not None:
        rows = np.empty(len(faces), np.dtype([("count", "u1"), ("vertices", "<i4", 3)]))
        rows["count"], rows["vertices"] = 3, faces
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        content += rows.tobytes()
    write_bytes(path, ("\n".join([*header, "end_header"]) + "\n").encode("ascii", errors="replace") + content)
