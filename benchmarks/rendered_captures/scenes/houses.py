"""The houses of a block: walls, windows, roofs and photovoltaic modules, with what is wrong with them."""

from typing import NamedTuple

import numpy as np

from rendered_captures.materials import gloss, matte
from rendered_captures.meshes.mesh import move
from rendered_captures.meshes.solids import mesh_prism
from rendered_captures.scene_builder import Builder
from rendered_captures.scenes.anomalies import Anomalies
from rendered_captures.scenes.dates import Date
from rendered_captures.temperature_fields import hidden_heat_field, temperature_field
from rendered_captures.textures.noise import mottle
from rendered_captures.textures.prints import panel_texture
from rendered_captures.textures.surfaces import brick_texture, tiles_texture

_PLACES = ((-24, 12), (-24, -13.5), (3, 12.5), (18, 12), (4.5, -14), (22, -14.5))
"""Of the houses [m]."""
_WALLS = ((206, 190, 158), (170, 90, 66), (214, 210, 200), (186, 170, 140), (200, 160, 120), (160, 168, 172))
_TILES = ((150, 70, 56), (108, 60, 54), (90, 92, 98), (0, 0, 0), (140, 84, 60), (72, 76, 84))
_FLAT = 3
_POOR = (1, 4)
"""Houses whose rafters show through until they are insulated."""
_WITH_MODULES = (0, 2, 5)
Place = tuple[float, float, float]


class Placed(NamedTuple):
    """From coordinates of a house or a car to those of the block."""

    x: float
    y: float
    degrees: float

    def __call__(self, u: float, v: float, z: float) -> Place:
        """The place [m] of the point (u, v, z)."""
        c, s = np.cos(np.radians(self.degrees)), np.sin(np.radians(self.degrees))
        return (self.x + c * u - s * v, self.y + s * u + c * v, z)


def add_house(b: Builder, found: Anomalies, i: int, today: Date) -> None:
    """Walls, windows and a roof.

    Args:
        b: The scene.
        found: Takes what is wrong with the house.
        i: Its number, 0 to 5.
        today: The date.
    """
    r, base = b.rng, today.air
    hx, hy = _PLACES[i]
    w, d, h = 9.5 + 4 * r.random(), 7.0 + 2.5 * r.random(), 3.2 + 3 * r.random()
    rz = float(r.choice([0, 90])) if i != 3 else 0.0
    at = Placed(hx, hy, rz)
    col = _WALLS[i]
    b.box(
        f"house{i}",
        at(0, 0, h / 2),
        (w, d, h),
        matte(brick_texture(900, 2200, r, 40, c=col) if i % 2 else mottle(col, 700, 1800, r, 0.25, 9)),
        hidden_heat_field(base + 2.0, base + 4.2, r, "studs", up=1.2, width=6),
        rz=rz,
    )
    for q, (u, v, ww, hh, rr) in enumerate(
        (
            (w / 2 + 0.03, -1.6, 1.2, 1.3, 90),
            (w / 2 + 0.03, 1.7, 1.2, 1.3, 90),
            (-2.2, -d / 2 - 0.03, 1.5, 1.3, 0),
            (2.0, -d / 2 - 0.03, 1.5, 1.3, 0),
            (-1.5, d / 2 + 0.03, 1.5, 1.3, 0),
            (-w / 2 - 0.03, 0.4, 1.2, 1.3, 90),
        )
    ):
        b.box(
            f"win{i}_{q}",
            at(u, v, h * 0.55),
            (ww, 0.05, hh),
            gloss((26, 30, 36)),
            temperature_field(base + 3.2, r, 0.3),
            rz=rz + rr,
            eps=0.86,
            mirror=0,
            disc="glass",
            about="window",
        )
    if i == _FLAT:
        _add_flat_roof(b, found, i, at, (w, d, h), today)
        return
    p = np.radians(28 + 10 * r.random())
    _add_pitched_roof(b, found, i, at, (w, d, h), p, today)
    if i in _WITH_MODULES:
        _add_modules(b, found, i, at, (w, d, h), p, today)


def _add_flat_roof(b: Builder, found: Anomalies, i: int, at: Placed, size: Place, today: Date) -> None:
    """A membrane over wet insulation, skylights, a hot unit."""
    r, rz, (w, d, h), base = b.rng, at.degrees, size, today.air
    b.box(
        f"roof{i}",
        at(0, 0, h + 0.1),
        (w + 0.4, d + 0.4, 0.2),
        matte(mottle((150, 150, 146), 1200, 1500, r, 0.4, 14, 5, 8)),
        temperature_field(base + 3, r, 0.5, spots=today.wet, n=256),
        rz=rz,
        disc="hidden_heat",
        about="membrane over wet insulation",
    )
    for u, v, sigma, excess in today.wet:
        found.note(
            "wet insulation",
            f"roof{i}",
            *at((u - 0.5) * (w + 0.4), (v - 0.5) * (d + 0.4), 0)[:2],
            np.pi * (2 * sigma) ** 2 * (w + 0.4) * (d + 0.4),
            excess,
            "wet insulation under the membrane",
        )
    for q in range(3):
        b.box(
            f"sky{q}",
            at(-3 + 2.6 * q, 1.6, h + 0.32),
            (1.2, 1.2, 0.16),
            gloss((120, 150, 170)),
            temperature_field(base + 6, r, 0.3),
            rz=rz,
            eps=0.86,
            mirror=0,
            disc="glass",
            about="skylight",
        )
    b.box(
        "unit",
        at(2.4, -1.5, h + 0.7),
        (1.6, 1.1, 1.0),
        matte(panel_texture(400, 560, r, (196, 196, 190), "AC 4")),
        temperature_field(base + 17, r, 0.4, up=5),
        rz=rz,
    )
    found.note("hot unit", "unit", *at(2.4, -1.5, 0)[:2], 1.76, 15, "air handling unit")


def _add_pitched_roof(b: Builder, found: Anomalies, i: int, at: Placed, size: Place, p: float, today: Date) -> None:
    """Two sides of tiles, a gable and a chimney; ``p`` is the pitch [rad]."""
    r, rz, (w, d, h), base = b.rng, at.degrees, size, today.air
    s_len = (d / 2 + 0.35) / np.cos(p)
    zc = h + (d / 2) * np.tan(p) / 2 + 0.02
    poor = i in _POOR
    retro = i in today.insulated
    tile = _TILES[i]
    for side in (-1, 1):
        T = hidden_heat_field(
            base + (0.6 if retro else 1.5), base + (1.0 if retro else 5.0 if poor else 2.0), r, "studs", width=5
        )
        b.box(
            f"roof{i}_{side + 1}",
            at(0, side * (d / 4 + 0.17), zc),
            (w + 0.7, s_len, 0.14),
            matte(tiles_texture(1100, 1500, r, 34, (tile, tuple(int(0.82 * t) for t in tile)), 2)),
            T,
            rz=rz,
            rx=-side * np.degrees(p),
            disc="hidden_heat" if poor else None,
            about="roof without insulation between the rafters" if poor else "",
        )
    if poor:
        found.note(
            "missing insulation",
            f"roof{i}",
            at.x,
            at.y,
            2 * (w + 0.7) * s_len,
            0.4 if retro else 3.5,
            "rafters show through",
        )
    b.add(
        f"gable{i}",
        move(
            mesh_prism([(-d / 2, h - 0.02), (d / 2, h - 0.02), (0, h + d / 2 * np.tan(p) - 0.1)], -w / 2, w / 2),
            at(0, 0, 0),
            rz=rz + 90,
        ),
        matte(mottle(_WALLS[i], 300, 500, r, 0.25, 9)),
        temperature_field(base + 2.2, r, 0.3),
    )
    b.box(
        f"chimney{i}",
        at(w * 0.28, 0.5, h + d / 2 * np.tan(p) * 0.75 + 0.5),
        (0.7, 0.7, 1.9),
        matte(brick_texture(300, 300, r, 12)),
        temperature_field(base + (16 if i in (0, 4) else 3), r, 0.4, up=6),
        rz=rz,
    )


def _add_modules(b: Builder, found: Anomalies, i: int, at: Placed, size: Place, p: float, today: Date) -> None:
    """Ten photovoltaic modules on one side of the roof."""
    r, rz, (w, d, h), base = b.rng, at.degrees, size, today.air
    side = -1 if i != 2 else 1
    k = 0
    for a in range(5):
        for e in range(2):
            u = -w / 2 + 1.5 + 1.08 * a
            f = 0.30 + 0.38 * e
            v = side * (d / 2 + 0.35) * (1 - f)
            z = h + (d / 2) * np.tan(p) - abs(v) * np.tan(p) + 0.36
            hot = (i, a, e) in ((0, 1, 1), (2, 3, 0), (5, 2, 1)) and i not in today.repaired
            T = temperature_field(base + 12, r, 0.5, spots=[(0.7, 0.3, 0.07, 13)] if hot else (), n=64) + (
                0 if not (i == 5 and a == 4) else 4.5
            )
            b.box(
                f"pv{i}_{k}",
                at(u, v, z),
                (1.02, 1.62, 0.05),
                gloss(tiles_texture(340, 210, r, 6, ((22, 28, 58), (26, 34, 66)), 2)),
                T,
                rz=rz,
                rx=-side * np.degrees(p),
                eps=0.88,
                mirror=0.15,
                disc="specular",
                about="module",
            )
            if hot:
                found.note("hot cell", f"pv{i}_{k}", *at(u + 0.2, v, 0)[:2], 0.06, 13, "hot cell")
            if i == 5 and a == 4:
                found.note("module in open circuit", f"pv{i}_{k}", *at(u, v, 0)[:2], 1.65, 4.5, "whole module warmer")
            k += 1
