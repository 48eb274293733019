"""Temperatures over a surface [deg C], in texture coordinates: row 0 is the top."""

from collections.abc import Sequence

import cv2
import numpy as np

from rendered_captures.textures.noise import Floats, fbm


def temperature_field(
    base: float,
    rng: np.random.Generator,
    noise: float = 0.25,
    up: float = 0.0,
    right: float = 0.0,
    spots: Sequence[tuple[float, float, float, float]] = (),
    n: int = 128,
) -> Floats:
    """Smooth field: base + linear gradient (total change `up`, `right`) + low-frequency noise + Gaussian spots
    (u, v, sigma, dT) in texture coordinates; row 0 is the top."""
    v, u = np.meshgrid(1 - (np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n, indexing="ij")
    t = base + up * (v - 0.5) + right * (u - 0.5) + noise * 2 * (fbm(n, n, rng, 3, 2) - 0.5)
    for su, sv, s, d in spots:
        t = t + d * np.exp(-((u - su) ** 2 + (v - sv) ** 2) / (2 * s * s))
    return t.astype(np.float32)


_BRANCHES = ((0.9, 0.25), (0.1, 0.45), (0.9, 0.65), (0.1, 0.82))
TREE = [
    ((0.5, 1.0), (0.5, 0.12), 1.0, 4),
    *(((0.5, v), (u, v), 0.85, 0) for u, v in _BRANCHES),
    *(((u, v), (u, v - 0.12), 0.7, 0) for u, v in _BRANCHES),
]
"""Pipes of the kind ``tree``: two ends from the top left as shares of the field, strength, and by how many pixels it is
wider than the others."""


def hidden_heat_field(
    base: float,
    hot: float,
    rng: np.random.Generator,
    kind: str = "serpentine",
    n: int = 256,
    width: int = 9,
    blur: float = 3.0,
    up: float = 0.0,
) -> Floats:
    """Heat under a surface, invisible in RGB: heating loop, pipe tree or studs, diffused by the cover."""
    m = np.zeros((n, n), np.float32)
    if kind == "serpentine":
        y, x0, x1, pts = 0.12, 0.1, 0.9, []
        while y < 0.9:
            pts += [(x0, y), (x1, y)]
            x0, x1 = x1, x0
            y += 0.13
        cv2.polylines(m, [np.int32(np.array(pts) * n)], False, 1.0, width)
    elif kind == "tree":
        for start, end, strength, wider in TREE:
            ends = [(int(n * u), int(n * v)) for u, v in (start, end)]
            cv2.line(m, *ends, strength, width + wider)
    elif kind == "studs":
        for f in np.linspace(0.06, 0.94, 9):
            cv2.line(m, (int(n * f), 0), (int(n * f), n), 1.0, max(2, width // 3))
        for f in (0.33, 0.67):
            cv2.line(m, (0, int(n * f)), (n, int(n * f)), 1.0, width // 2)
    m = cv2.GaussianBlur(m, (0, 0), blur)
    fade = 0.75 + 0.25 * np.linspace(1, 0, n)[:, None]
    return (temperature_field(base, rng, 0.3, up, n=n) + (hot - base) * m * fade).astype(np.float32)
