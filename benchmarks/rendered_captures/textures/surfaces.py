"""Wood, brick, stone, leaves and asphalt, sRGB of 8 bits."""

from collections.abc import Sequence

import cv2
import numpy as np

from rendered_captures.textures.noise import Bytes, Color, fbm, mottle, u8


def wood_texture(
    h: int, w: int, rng: np.random.Generator, c1: Color = (122, 78, 42), c2: Color = (196, 148, 92)
) -> Bytes:
    """Grain and rings."""
    g = fbm(h, w, rng, 3, 5, 0.5, sx=0.15)
    ring = 0.5 + 0.5 * np.sin(2 * np.pi * (g * 9 + np.linspace(0, 4, h)[:, None]))
    t = np.clip(0.65 * ring + 0.35 * fbm(h, w, rng, 60, 2, 0.5, sx=0.05), 0, 1)[..., None]
    return u8((1 - t) * np.array(c1) + t * np.array(c2) + rng.normal(0, 4, (h, w, 1)))


def planks_texture(h: int, w: int, rng: np.random.Generator, n: int = 8) -> Bytes:
    """Rows of boards."""
    img = np.zeros((h, w, 3), np.uint8)
    for i in range(n):
        a, b = i * h // n, (i + 1) * h // n
        x = 0
        while x < w:
            e = min(w, x + int(w * rng.uniform(0.25, 0.5)))
            k = rng.uniform(0.7, 1.1)
            img[a:b, x:e] = u8(wood_texture(b - a, max(e - x, 2), rng)[:, : e - x] * k)
            cv2.rectangle(img, (x, a), (e - 1, b - 1), (45, 28, 16), 2)
            x = e
    return img


def brick_texture(
    h: int,
    w: int,
    rng: np.random.Generator,
    rows: int = 40,
    ratio: float = 2.6,
    c: Color = (150, 72, 52),
    mortar: Color = (176, 168, 156),
) -> Bytes:
    """Bricks of many shades."""
    img = mottle(mortar, h, w, rng, 0.2, 9, 20, 4)
    bh = h / rows
    bw = bh * ratio
    for r in range(rows):
        for k in range(-1, int(w / bw) + 2):
            x0, y0 = int((k + 0.5 * (r % 2)) * bw) + 2, int(r * bh) + 2
            col = np.array(c) * rng.uniform(0.55, 1.35) + rng.normal(0, 8, 3)
            cv2.rectangle(
                img, (x0, y0), (int(x0 + bw - 4), int(y0 + bh - 4)), tuple(map(float, np.clip(col, 0, 255))), -1
            )
    f = 0.75 + 0.5 * fbm(h, w, rng, 3, 6, 0.6)
    return u8(img * f[..., None] + rng.normal(0, 8, (h, w, 1)))


def tiles_texture(
    h: int,
    w: int,
    rng: np.random.Generator,
    n: int = 10,
    cols: Sequence[Color] = ((205, 200, 190), (92, 88, 84)),
    grout: int = 3,
) -> Bytes:
    """Checker of stained stone tiles with marble-like veins."""
    img = np.zeros((h, w, 3), np.float32)
    s = h / n
    for i in range(n):
        for j in range(int(np.ceil(w / s))):
            c = np.array(cols[(i + j) % len(cols)], np.float32) * rng.uniform(0.8, 1.12)
            img[int(i * s) + grout : int((i + 1) * s), int(j * s) + grout : int((j + 1) * s)] = c
    vein = np.abs(fbm(h, w, rng, 6, 6, 0.6) - 0.5)
    f = (0.8 + 0.4 * fbm(h, w, rng, 3, 7, 0.7)) * np.clip(0.7 + vein * 9, 0.7, 1)
    return u8(img * f[..., None] + rng.normal(0, 5, (h, w, 1)))


def foliage_texture(h: int, w: int, rng: np.random.Generator, c: Color = (70, 110, 40)) -> Bytes:
    """Leaves from afar, or bark."""
    t = fbm(h, w, rng, 8, 6, 0.75)[..., None]
    return u8(
        np.array(c) * (0.45 + 1.2 * t)
        + np.array((50, 30, 0)) * fbm(h, w, rng, 5, 3)[..., None]
        + rng.normal(0, 10, (h, w, 1))
    )


def ground_texture(h: int, w: int, rng: np.random.Generator) -> Bytes:
    """Asphalt with aggregate, patches, cracks, lane paint and a strip of pavers (unique over the whole texture)."""
    img = mottle((96, 94, 92), h, w, rng, 0.32, 15, 4, 8).astype(np.float32)
    for _ in range(26):
        p = rng.uniform(0, [w, h])
        pts = np.cumsum(np.vstack([p, rng.normal(0, w * 0.012, (24, 2)) + rng.normal(0, w * 0.01, 2)]), 0)
        cv2.polylines(img, [np.int32(pts)], False, (38, 36, 35), int(rng.integers(2, 5)), cv2.LINE_AA)
    for _ in range(9):
        x, y = rng.uniform(0, w), rng.uniform(0, h)
        s = rng.uniform(0.02, 0.06) * w
        cv2.fillPoly(
            img, [np.int32(np.array([x, y]) + rng.normal(0, s, (5, 2)))], tuple([float(rng.uniform(45, 130))] * 3)
        )
    img = u8(img)
    for k in range(7):  # parking bay lines
        x = int(w * (0.14 + 0.12 * k))
        cv2.line(img, (x, int(h * 0.12)), (x, int(h * 0.5)), (215, 212, 198), w // 170)
        cv2.putText(
            img,
            str(11 + k),
            (x + w // 45, int(h * 0.47)),
            cv2.FONT_HERSHEY_TRIPLEX,
            w / 900,
            (215, 190, 90),
            max(3, w // 300),
            cv2.LINE_AA,
        )
    band = tiles_texture(h // 8, w, rng, 6, ((168, 122, 98), (140, 128, 118), (186, 160, 130)), 4)
    img[: h // 8] = band
    f = 0.8 + 0.4 * fbm(h, w, rng, 6, 5, 0.6)
    return u8(img * f[..., None])


def leafwall_texture(h: int, w: int, rng: np.random.Generator) -> Bytes:
    """A hedge: single leaves before foliage."""
    img = foliage_texture(h, w, rng)
    for _ in range(2600):
        x, y = rng.uniform(0, w), rng.uniform(0, h)
        a = rng.uniform(0, 180)
        c = np.array((70, 115, 42)) * rng.uniform(0.35, 1.7)
        cv2.ellipse(
            img,
            (int(x), int(y)),
            (int(rng.uniform(6, 17)), int(rng.uniform(3, 7))),
            a,
            0,
            360,
            tuple(map(float, np.clip(c, 0, 255))),
            -1,
            cv2.LINE_AA,
        )
    return img
