"""Pipes along a line, and clouds of leaves."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendered_captures.meshes.mesh import Mesh


def fillet(pts: Sequence[Sequence[float]], r: float, n: int = 8) -> NDArray[Any]:
    """Round the corners of a polyline."""
    corners = [np.asarray(p, float) for p in pts]
    out = [corners[0]]
    for a, b, c in zip(corners, corners[1:], corners[2:]):
        d0, d1 = (a - b), (c - b)
        cut = min(r, np.linalg.norm(d0) / 2.05, np.linalg.norm(d1) / 2.05)
        p, q = b + d0 / np.linalg.norm(d0) * cut, b + d1 / np.linalg.norm(d1) * cut
        out += [(1 - t) ** 2 * p + 2 * t * (1 - t) * b + t * t * q for t in np.linspace(0, 1, n)]
    return np.array([*out, corners[-1]])


def densify(pts: Sequence[Sequence[float]], n: int = 12) -> NDArray[Any]:
    """Points along a straight line, [n, 3]."""
    a, b = np.asarray(pts[0], float), np.asarray(pts[1], float)
    return a + np.linspace(0, 1, n)[:, None] * (b - a)


def mesh_tube(pts: NDArray[Any], r: float, n: int = 24) -> Mesh:
    """Pipe swept along a polyline (parallel transport); u runs along the pipe, v around it."""
    P = np.asarray(pts, float)
    T = np.gradient(P, axis=0)
    T /= np.linalg.norm(T, axis=1, keepdims=True)
    a = np.cross(T[0], (0.31, 0.52, 0.79))
    a /= np.linalg.norm(a)
    s = np.r_[0, np.cumsum(np.linalg.norm(np.diff(P, axis=0), axis=1))]
    s /= s[-1]
    th = np.linspace(0, 2 * np.pi, n + 1)
    V, N, UV, F = [], [], [], []
    for i in range(len(P)):
        a = a - T[i] * (a @ T[i])
        a /= np.linalg.norm(a)
        b = np.cross(T[i], a)
        q = np.cos(th)[:, None] * a + np.sin(th)[:, None] * b
        V.append(P[i] + r * q)
        N.append(q)
        UV.append(np.stack([np.full_like(th, s[i]), th / (2 * np.pi)], 1))
        if i:
            k = (i - 1) * (n + 1) + np.arange(n)
            t = k + n + 1
            F += [np.stack([k, k + 1, t + 1], 1), np.stack([k, t + 1, t], 1)]
    for i, sg in ((0, -1), (len(P) - 1, 1)):  # end caps
        k = sum(map(len, V))
        m = np.arange(1, n + 1)
        V.append(np.vstack([P[i], V[i]]))
        N.append(np.repeat(sg * T[i : i + 1], n + 2, 0))
        UV.append(np.vstack([[s[i], 0.5], UV[i]]))
        F.append(k + (np.stack([0 * m, m, m + 1], 1) if sg > 0 else np.stack([0 * m, m + 1, m], 1)))
    return Mesh(np.concatenate(V), np.concatenate(F), np.concatenate(UV), np.concatenate(N))


def mesh_leaves(
    center: Sequence[float], radius: Sequence[float], count: int, size: float, rng: np.random.Generator
) -> Mesh:
    """A cloud of two-faced leaves (kites), each leaf coloured from a random spot of its texture."""
    V, N, UV, F = [], [], [], []
    for _ in range(count):
        d = rng.normal(0, 1, 3)
        d /= np.linalg.norm(d)
        c = np.asarray(center) + d * np.asarray(radius) * rng.uniform(0.35, 1) ** 0.5
        n = d + rng.normal(0, 0.7, 3)
        n /= np.linalg.norm(n)
        u = np.cross(n, rng.normal(0, 1, 3))
        u /= np.linalg.norm(u)
        w = np.cross(n, u)
        L = size * rng.uniform(0.6, 1.3)
        uv0 = rng.uniform(0, 0.85, 2)
        for s in (1, -1):
            k = len(V)
            for a, b in ((-1, 0), (0, -0.45), (1, 0), (0, 0.45)):
                V.append(c + L * (a * u + b * w) / 2 + s * n * 0.0001)
                N.append(s * n)
                UV.append(uv0 + 0.1 * np.array([a + 1, b + 1]) / 2)
            F += [(k, k + 1, k + 2), (k, k + 2, k + 3)] if s > 0 else [(k, k + 2, k + 1), (k, k + 3, k + 2)]
    return Mesh(np.array(V), np.array(F), np.array(UV), np.array(N))
