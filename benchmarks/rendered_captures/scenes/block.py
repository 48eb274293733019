"""A block of six houses with streets, as a drone sees it on several dates."""

from typing import Any

import numpy as np

from rendered_captures.materials import gloss, matte
from rendered_captures.scene_builder import Builder
from rendered_captures.scenes.anomalies import Anomalies
from rendered_captures.scenes.dates import DATES, Date
from rendered_captures.scenes.houses import Placed, add_house
from rendered_captures.skies import sky_rgb, sky_T
from rendered_captures.temperature_fields import TREE, hidden_heat_field, temperature_field
from rendered_captures.textures.noise import mottle
from rendered_captures.textures.prints import decal_texture
from rendered_captures.textures.surfaces import foliage_texture, ground_texture, leafwall_texture

WIDTH, DEPTH = 62.0, 46.0
"""Of the block [m]."""
_GROUND = np.array([WIDTH + 44, DEPTH + 40])
"""Sides of its ground [m]."""
PIPES = (np.array([ends for *ends, _, _ in TREE]) - 0.5) * (1, -1) * _GROUND
"""Both ends of each buried pipe, (x, y) [m], [N, 2, 2]."""


def block(seed: int, date: int) -> tuple[Builder, list[dict[str, Any]]]:
    """The block on a date, and what is thermally wrong on it.

    Args:
        seed: Of the block; all dates of one block have the same.
        date: Number in ``DATES``.
    """
    r = np.random.default_rng([seed, 77])
    today = DATES[date]
    b = Builder(r, today.unset)
    b.key = 0.17
    b.env_rgb = sky_rgb(r, (0.32, 0.52, 1.0), (0.95, 1.0, 1.1), 0.7)
    b.env_T = sky_T(*today.sky, 10)
    b.sun = today.sun
    base = today.air
    found = Anomalies()

    leak = (0.63 + 0.02 * r.random(), 0.40, *today.leak)
    ground_T = hidden_heat_field(base, base + 2.6, r, "tree", n=512, width=5, blur=2.5) + temperature_field(
        0, r, 0.8, spots=[leak], n=512
    )
    b.box(
        "ground",
        (0, 0, -0.1),
        (*_GROUND, 0.2),
        matte(ground_texture(3000, 3600, r)),
        ground_T,
        disc="hidden_heat",
        about="buried district heating with a leak",
    )
    found.note(
        "leak",
        "ground",
        (leak[0] - 0.5) * _GROUND[0],
        (leak[1] - 0.5) * _GROUND[1],
        np.pi * (2 * leak[2]) ** 2 * _GROUND.prod(),
        leak[3],
        "leak of the buried pipe",
    )
    for k, (c, s) in enumerate(
        (((0, -2.2, 0.02), (WIDTH + 40, 6.4, 0.05)), ((-8.5, 0, 0.025), (5.2, DEPTH + 36, 0.05)))
    ):
        b.box(
            f"road{k}",
            c,
            s,
            matte(mottle((92, 92, 94), 900, 3000, r, 0.4, 16, 6, 8)),
            temperature_field(base + 4.5, r, 0.7, n=256),
        )
    for k in range(16):
        b.box(
            f"mark{k}",
            (-34 + 4.6 * k, -2.2, 0.052),
            (1.8, 0.16, 0.01),
            matte((225, 225, 215)),
            temperature_field(base + 3.6, r, 0.1),
        )
    for i in range(6):
        add_house(b, found, i, today)
    _add_cars(b, today)
    _add_plants(b, base)
    return b, found.found


def _add_cars(b: Builder, today: Date) -> None:
    r, base = b.rng, today.air
    cars = [(-12.0, -4.1, 0, 14), (6.5, -0.4, 180, 2), (26, -4.0, 0, 9), (-8.6 + 1.2, 16, 90, 3)]
    for k, (x, y, rz, hot) in enumerate(cars):
        x += today.cars[k % 2]
        col = [(158, 28, 30), (230, 230, 226), (40, 60, 110), (60, 62, 66)][k]
        at = Placed(x, y, rz)
        b.box(
            f"car{k}",
            at(0, 0, 0.55),
            (4.2, 1.75, 0.7),
            gloss(decal_texture(300, 1200, r, col, f"KAT {k}")),
            temperature_field(base + 6, r, 0.4),
            rz=rz,
        )
        b.box(
            f"cabin{k}",
            at(-0.3, 0, 1.15),
            (2.1, 1.5, 0.55),
            gloss((20, 24, 30)),
            temperature_field(base + 4, r, 0.3),
            rz=rz,
            eps=0.86,
            mirror=0,
        )
        b.box(
            f"hood{k}",
            at(1.45, 0, 0.92),
            (1.2, 1.6, 0.06),
            gloss(mottle(col, 200, 200, r, 0.12, 2)),
            temperature_field(base + 6 + hot, r, 0.4, spots=[(0.5, 0.5, 0.2, hot)]),
            rz=rz,
        )


def _add_plants(b: Builder, base: float) -> None:
    """Trees, and boxes that lie about."""
    r = b.rng
    for k in range(11):
        x, y = [
            (-33, 4),
            (-16, 20),
            (-14, -20),
            (-3, 21),
            (11, 20),
            (29, 5),
            (32, 20),
            (-33, -21),
            (14, -20),
            (33, -22),
            (-2.2, -8.5),
        ][k]
        q = 1.1 + 0.7 * r.random()
        b.cyl(
            f"trunk{k}",
            (x, y, 0),
            0.16,
            2.2,
            matte(foliage_texture(200, 200, r, (92, 74, 56))),
            temperature_field(base, r, 0.3),
        )
        b.leaves(
            f"tree{k}",
            (x, y, 2.6 + 0.3 * q),
            (q, q, 0.9 * q),
            420,
            0.34,
            matte(leafwall_texture(512, 512, r)),
            temperature_field(base - 1.2, r, 0.4),
            eps=0.96,
        )
    for k in range(14):
        x, y = -32 + 64 * r.random(), -21 + 42 * r.random()
        b.box(
            f"clutter{k}",
            (x, y, 0.3),
            (0.6 + r.random(), 0.6 + 0.8 * r.random(), 0.6),
            matte(decal_texture(240, 300, r, tuple(int(v) for v in r.integers(60, 220, 3)), f"B{k}")),
            temperature_field(base + 1 + 3 * r.random(), r, 0.4),
            rz=float(90 * r.random()),
        )
