"""Boxes, surfaces of revolution and prisms."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendered_captures.meshes.mesh import Mesh, vertex_normals


def mesh_box(s: Sequence[float]) -> Mesh:
    """Box of size s at the origin; each face uv 0..1, v up on the sides."""
    X, Y, Z = np.eye(3)
    V, N, UV, F = [], [], [], []
    for n, u, v in ((X, Y, Z), (-X, -Y, Z), (Y, -X, Z), (-Y, X, Z), (Z, X, Y), (-Z, X, -Y)):
        k = len(V)
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            V.append((n + a * u + b * v) * np.asarray(s) / 2)
            N.append(n)
            UV.append(((a + 1) / 2, (b + 1) / 2))
        F += [(k, k + 1, k + 2), (k, k + 2, k + 3)]
    return Mesh(np.array(V), np.array(F), np.array(UV), np.array(N))


def mesh_face(s: Sequence[float], k: int) -> Mesh:
    """Face k of mesh_box alone (order +x -x +y -y +z -z)."""
    V, _, UV, N = mesh_box(s)
    part = slice(4 * k, 4 * k + 4)
    return Mesh(V[part], np.array([(0, 1, 2), (0, 2, 3)]), UV[part], N[part])


def mesh_lathe(profile: Sequence[tuple[float, float]] | NDArray[Any], n: int = 56) -> Mesh:
    """Surface of revolution about z; profile = [(r, z), ...] from bottom to top; corners over 40 deg stay sharp."""
    P = np.asarray(profile, float)
    d = np.diff(P, axis=0)
    L = np.linalg.norm(d, axis=1)
    d = d / L[:, None]
    nrm = np.stack([d[:, 1], -d[:, 0]], 1)
    S = np.r_[0, np.cumsum(L)] / L.sum()
    a = np.linspace(0, 2 * np.pi, n + 1)
    V, N, UV, F = [], [], [], []
    for i in range(len(d)):
        n0 = nrm[i] + nrm[i - 1] if i and nrm[i] @ nrm[i - 1] > 0.77 else nrm[i]
        n1 = nrm[i] + nrm[i + 1] if i + 1 < len(d) and nrm[i] @ nrm[i + 1] > 0.77 else nrm[i]
        for (r, z), q, s in ((P[i], n0, S[i]), (P[i + 1], n1, S[i + 1])):
            q = q / np.linalg.norm(q)
            V.append(np.stack([r * np.cos(a), r * np.sin(a), np.full_like(a, z)], 1))
            N.append(np.stack([q[0] * np.cos(a), q[0] * np.sin(a), np.full_like(a, q[1])], 1))
            UV.append(np.stack([a / (2 * np.pi), np.full_like(a, s)], 1))
        k = 2 * i * (n + 1) + np.arange(n)
        t = k + n + 1
        F += [np.stack([k, k + 1, t + 1], 1), np.stack([k, t + 1, t], 1)]
    return Mesh(np.concatenate(V), np.concatenate(F), np.concatenate(UV), np.concatenate(N))


def mesh_cyl(r: float, h: float) -> Mesh:
    """A cylinder that stands on the origin."""
    return mesh_lathe([(1e-4, 0), (r, 0), (r, h), (1e-4, h)])


def mesh_ball(r: float, rng: np.random.Generator, rough: float = 0.0, n: int = 64) -> Mesh:
    """Sphere, or with `rough` a lumpy boulder/bush (radial noise)."""
    t = np.linspace(-np.pi / 2, np.pi / 2, n // 2 + 1)
    V, F, UV, N = mesh_lathe(np.stack([np.maximum(r * np.cos(t), 1e-4), r * np.sin(t)], 1), n)
    if rough:
        D = V / np.linalg.norm(V, axis=1, keepdims=True)
        k = rng.normal(0, 2.6, (10, 3))
        ph = rng.uniform(0, 6.28, 10)
        V = V * (1 + rough * np.sin(D @ k.T + ph).mean(1, keepdims=True) * 1.6)
        N = vertex_normals(V, F)
    return Mesh(V, F, UV, N)


def mesh_prism(poly: Sequence[tuple[float, float]], y0: float, y1: float) -> Mesh:
    """Convex polygon in x-z (counter-clockwise seen from -y) extruded along y; sides uv over the bounding box."""
    P = np.asarray(poly, float)
    lo, ex = P.min(0), np.ptp(P, 0)
    m = len(P)
    V, N, UV, F = [], [], [], []
    for y, s in ((y0, -1), (y1, 1)):
        k = len(V)
        for x, z in P:
            V.append((x, y, z))
            N.append((0, s, 0))
            UV.append(((x - lo[0]) / ex[0], (z - lo[1]) / ex[1]))
        F += [(k, k + i, k + i + 1) if s < 0 else (k, k + i + 1, k + i) for i in range(1, m - 1)]
    for i in range(m):
        a, b = P[i], P[(i + 1) % m]
        k = len(V)
        n = np.array([(b - a)[1], 0, -(b - a)[0]])
        n /= np.linalg.norm(n)
        for (x, z), y, u, v in ((a, y0, 0, 0), (b, y0, 1, 0), (b, y1, 1, 1), (a, y1, 0, 1)):
            V.append((x, y, z))
            N.append(n)
            UV.append((u, v))
        F += [(k, k + 2, k + 1), (k, k + 3, k + 2)]
    V, F, N = np.array(V), np.array(F), np.array(N)
    flip = np.einsum("ij,ij->i", np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]), N[F[:, 0]]) < 0
    F[flip] = F[flip][:, ::-1]
    return Mesh(V, F, np.array(UV), N)
