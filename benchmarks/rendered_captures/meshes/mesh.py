"""A mesh, where it stands, and its file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Mesh(NamedTuple):
    """Triangles with normals and texture coordinates."""

    vertices: NDArray[Any]
    """[V, 3] [m]."""
    faces: NDArray[Any]
    """[F, 3], counter-clockwise from outside."""
    uv: NDArray[Any]
    """[V, 2], 0 to 1."""
    normals: NDArray[Any]
    """[V, 3]."""


def vertex_normals(vertices: NDArray[Any], faces: NDArray[Any]) -> NDArray[Any]:
    """The mean normals of the faces at each vertex, weighted by their angles there, [V, 3]."""
    corners, normals = vertices[faces], np.zeros_like(vertices)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    for k in range(3):
        sides = [corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2)]
        first, second = (side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12) for side in sides)
        angles = np.arccos(np.clip((first * second).sum(axis=1), -1, 1))
        np.add.at(normals, faces[:, k], across * angles[:, None])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def planar_uv(mesh: Mesh) -> Mesh:
    """Replace the texture coordinates by the view from above."""
    low, high = mesh.vertices[:, :2].min(axis=0), mesh.vertices[:, :2].max(axis=0)
    return mesh._replace(uv=(mesh.vertices[:, :2] - low) / (high - low))


def move(mesh: Mesh, t: Sequence[float] = (0, 0, 0), rz: float = 0, rx: float = 0, ry: float = 0) -> Mesh:
    """Rotate (degrees, about x, then y, then z) and translate [m]."""
    turn = np.eye(3)
    for degrees, axis in ((rx, 0), (ry, 1), (rz, 2)):
        cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        one = np.eye(3)
        one[i, i], one[i, j], one[j, i], one[j, j] = cos, -sin, sin, cos
        turn = one @ turn
    return mesh._replace(vertices=mesh.vertices @ turn.T + np.asarray(t), normals=mesh.normals @ turn.T)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY file."""
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    vertices = np.zeros(len(mesh.vertices), [(name, "<f4") for name in names])
    for name, column in zip(names, np.hstack([mesh.vertices, mesh.normals, mesh.uv]).T, strict=True):
        vertices[name] = column
    faces = np.zeros(len(mesh.faces), [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, mesh.faces
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property float {name}\n" for name in names)
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(head.encode() + vertices.tobytes() + faces.tobytes())
