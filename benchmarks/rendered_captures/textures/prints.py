"""Things with writing on them: posters, books, panels, screens, keyboards, decals; sRGB of 8 bits."""

import cv2
import numpy as np

from rendered_captures.textures.noise import Bytes, Color, mottle, u8

# ------------------------------------------------------------------------------------- procedural textures (sRGB)
WORDS = (
    "thermal",
    "splat",
    "gaussian",
    "field",
    "radiance",
    "opacity",
    "kernel",
    "sensor",
    "bolometer",
    "lens",
    "flux",
    "night",
    "heat",
    "copper",
    "valve",
    "north",
    "river",
    "signal",
    "orbit",
    "amber",
    "delta",
    "engine",
    "museum",
    "garden",
    "orchid",
    "harvest",
)
"""What is written on things."""
FONTS = [cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_COMPLEX]


def text_block(
    img: Bytes, rng: np.random.Generator, x: int, y: int, w: int, lines: int, scale: float, color: Color
) -> None:
    """Lines of words, drawn into the image."""
    for i in range(lines):
        s = ""
        while cv2.getTextSize(s + "xxxxxx", FONTS[2], scale, 1)[0][0] < w:
            s += WORDS[rng.integers(len(WORDS))] + " "
        cv2.putText(img, s, (x, int(y + i * scale * 38)), FONTS[2], scale, color, max(1, int(scale * 2)), cv2.LINE_AA)


def poster_texture(h: int, w: int, rng: np.random.Generator, title: str = "RGB-T") -> Bytes:
    """A busy poster: colour fields, shapes, large and small text, a chart, a mosaic and a barcode."""

    def hsv(hue: int, saturation: int, value: int) -> tuple[int, ...]:
        return tuple(map(int, cv2.cvtColor(np.uint8([[[hue, saturation, value]]]), cv2.COLOR_HSV2RGB)[0, 0]))

    h0 = int(rng.integers(180))
    ramp = np.linspace(0, 1, h)[:, None, None]
    img = u8(
        (1 - ramp) * np.array(hsv(h0, 90, 245)) + ramp * np.array(hsv((h0 + 40) % 180, 150, 170)) + np.zeros((h, w, 1))
    )
    for _ in range(46):
        c = hsv(int(rng.integers(180)), int(rng.integers(90, 255)), int(rng.integers(40, 255)))
        x, y, r = int(rng.integers(w)), int(rng.integers(int(h * 0.2), h)), int(rng.uniform(0.015, 0.11) * w)
        k = rng.integers(4)
        if k == 0:
            cv2.circle(img, (x, y), r, c, -1, cv2.LINE_AA)
        elif k == 1:
            cv2.rectangle(img, (x, y), (x + r, y + int(r * rng.uniform(0.4, 2))), c, -1)
        elif k == 2:
            cv2.fillPoly(img, [np.int32(np.array([x, y]) + rng.normal(0, r, (3, 2)))], c, cv2.LINE_AA)
        else:
            cv2.circle(img, (x, y), r, c, max(2, r // 6), cv2.LINE_AA)
    m = rng.integers(0, 255, (7, 9, 3)).astype(np.uint8)
    mw, mh = int(w * 0.34), int(h * 0.2)
    img[int(h * 0.7) : int(h * 0.7) + mh, int(w * 0.06) : int(w * 0.06) + mw] = cv2.resize(
        m, (mw, mh), interpolation=cv2.INTER_NEAREST
    )
    x = int(w * 0.5)
    while x < w * 0.92:  # barcode
        e = int(rng.integers(2, 9))
        cv2.rectangle(img, (x, int(h * 0.88)), (x + e, int(h * 0.96)), (10, 10, 10), -1)
        x += e + int(rng.integers(3, 10))
    cv2.rectangle(img, (0, 0), (w, int(h * 0.17)), hsv((h0 + 90) % 180, 220, 70), -1)
    sc = w / (len(title) * 22.0)
    cv2.putText(
        img,
        title,
        (int(w * 0.04), int(h * 0.13)),
        FONTS[int(rng.integers(4))],
        sc,
        (250, 245, 230),
        max(2, int(sc * 2.4)),
        cv2.LINE_AA,
    )
    cv2.rectangle(img, (int(w * 0.48), int(h * 0.62)), (int(w * 0.96), int(h * 0.86)), (244, 240, 228), -1)
    text_block(img, rng, int(w * 0.5), int(h * 0.66), int(w * 0.44), 8, w / 1300, (25, 25, 30))
    cv2.rectangle(img, (4, 4), (w - 5, h - 5), (20, 20, 20), max(3, w // 110))
    return u8(img + rng.normal(0, 3, (h, w, 1)))


def books_texture(h: int, w: int, rng: np.random.Generator) -> Bytes:
    """The backs of a row of books."""
    img, x = np.zeros((h, w, 3), np.uint8), 0
    while x < w:
        e = min(w, x + int(rng.integers(w // 26, w // 11)))
        c = rng.integers(30, 225, 3)
        img[:, x:e] = c
        cv2.rectangle(img, (x, 0), (e, int(h * rng.uniform(0, 0.16))), (12, 10, 10), -1)
        for y in rng.uniform(0.2, 0.95, 3):
            cv2.rectangle(
                img, (x + 3, int(y * h)), (e - 3, int(y * h) + int(rng.integers(4, 26))), tuple(map(int, 255 - c)), -1
            )
        cv2.line(img, (x, 0), (x, h), (8, 8, 8), 3)
        x = e
    return u8(img + rng.normal(0, 5, (h, w, 1)))


def panel_texture(h: int, w: int, rng: np.random.Generator, c: Color = (206, 204, 196), name: str = "UNIT 7") -> Bytes:
    """Instrument front: dials, knobs, displays, labels, screws."""
    img = mottle(c, h, w, rng, 0.07, 3)
    for _ in range(5):
        x, y = int(rng.uniform(0.08, 0.6) * w), int(rng.uniform(0.3, 0.7) * h)
        ww, hh = int(rng.uniform(0.12, 0.3) * w), int(rng.uniform(0.12, 0.25) * h)
        cv2.rectangle(img, (x, y), (x + ww, y + hh), tuple(map(int, rng.integers(10, 120, 3))), -1)
        cv2.putText(
            img,
            f"{rng.uniform(0, 99):.2f}",
            (x + 4, y + hh - 6),
            FONTS[0],
            hh / 42,
            (120, 255, 140),
            max(1, hh // 26),
            cv2.LINE_AA,
        )
    for _ in range(14):
        x, y, r = int(rng.uniform(0.07, 0.93) * w), int(rng.uniform(0.25, 0.92) * h), int(rng.uniform(0.02, 0.055) * w)
        cv2.circle(img, (x, y), r, tuple(map(int, rng.integers(15, 235, 3))), -1, cv2.LINE_AA)
        a = rng.uniform(0, 6.28)
        cv2.line(
            img, (x, y), (int(x + r * np.cos(a)), int(y + r * np.sin(a))), (250, 250, 250), max(2, r // 5), cv2.LINE_AA
        )
    cv2.putText(
        img, name, (int(0.05 * w), int(0.2 * h)), FONTS[1], w / 420, (150, 20, 25), max(2, w // 220), cv2.LINE_AA
    )
    cv2.rectangle(img, (2, 2), (w - 3, h - 3), (40, 40, 44), 6)
    return img


def screen_texture(h: int, w: int, rng: np.random.Generator) -> Bytes:
    """A desktop with a window of code."""
    img = cv2.resize(poster_texture(h, w, rng, "workspace"), (w, h))
    cv2.rectangle(img, (int(w * 0.08), int(h * 0.2)), (int(w * 0.62), int(h * 0.9)), (24, 28, 36), -1)
    for i in range(14):
        cv2.putText(
            img,
            "def " + WORDS[rng.integers(len(WORDS))] + "(x): " + WORDS[rng.integers(len(WORDS))],
            (int(w * 0.1), int(h * (0.26 + 0.045 * i))),
            FONTS[2],
            w / 1500,
            tuple(map(int, rng.integers(110, 255, 3))),
            2,
            cv2.LINE_AA,
        )
    return img


def keyboard_texture(h: int, w: int, rng: np.random.Generator) -> Bytes:
    """Keys, letters and a touchpad."""
    img = mottle((58, 60, 66), h, w, rng, 0.1, 3)
    for r in range(6):
        for k in range(15):
            x, y = int(w * (0.05 + 0.06 * k)), int(h * (0.08 + 0.095 * r))
            cv2.rectangle(img, (x, y), (x + int(w * 0.05), y + int(h * 0.075)), (18, 18, 20), -1)
            cv2.putText(
                img,
                chr(65 + (r * 15 + k) % 26),
                (x + 6, y + int(h * 0.055)),
                FONTS[2],
                w / 1700,
                (225, 225, 225),
                1,
                cv2.LINE_AA,
            )
    cv2.rectangle(img, (int(w * 0.33), int(h * 0.7)), (int(w * 0.67), int(h * 0.96)), (90, 92, 98), -1)
    return img


def decal_texture(h: int, w: int, rng: np.random.Generator, c: Color, text: str = "LAB-07") -> Bytes:
    """Painted metal with stripes and lettering."""
    img = mottle(c, h, w, rng, 0.16, 3)
    k = 230 if sum(c) < 380 else 25
    cv2.rectangle(img, (0, int(h * 0.62)), (w, int(h * 0.70)), (k, k, k), -1)
    for x in range(0, w, w // 18):
        cv2.line(img, (x, int(h * 0.78)), (x + w // 36, int(h * 0.9)), (k, k, k - 20), max(3, w // 120))
    cv2.putText(
        img,
        text,
        (int(w * 0.08), int(h * 0.5)),
        FONTS[1],
        w / (len(text) * 30),
        (k, k, k),
        max(3, w // 130),
        cv2.LINE_AA,
    )
    return img
