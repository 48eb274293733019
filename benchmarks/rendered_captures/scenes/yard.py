"""A house front with windows, a parked car and a generator behind a tarpaulin, by day."""

import numpy as np

from rendered_captures.materials import gloss, matte, metal
from rendered_captures.meshes.solids import mesh_prism
from rendered_captures.paths import CameraPath, camera_arc
from rendered_captures.scene_builder import Builder
from rendered_captures.skies import sky_rgb, sky_T
from rendered_captures.temperature_fields import hidden_heat_field, temperature_field
from rendered_captures.textures.noise import mottle
from rendered_captures.textures.prints import books_texture, decal_texture, panel_texture, poster_texture
from rendered_captures.textures.surfaces import (
    brick_texture,
    foliage_texture,
    ground_texture,
    leafwall_texture,
    planks_texture,
    tiles_texture,
)


def yard(rng: np.random.Generator) -> tuple[Builder, CameraPath]:
    """Facade, car, street objects, by day."""
    b = Builder(rng, 22.0)
    b.fov, b.key = 60, 0.18
    b.env_rgb, b.env_T = sky_rgb(rng, (0.32, 0.52, 1.0), (0.95, 1.0, 1.1), 0.8), sky_T()
    b.sun = ((0.45, 0.62, -0.66), (5.2, 4.9, 4.3))
    b.box(
        "ground",
        (0, 1, -0.1),
        (26, 18, 0.2),
        matte(ground_texture(2048, 2960, rng)),
        temperature_field(
            34,
            rng,
            0.9,
            spots=[(0.435, 0.53, 0.05, -9), (0.36, 0.53, 0.04, -9), (0.62, 0.62, 0.03, -6)],
            n=256,
        ),
    )
    wall_T = hidden_heat_field(25, 28.5, rng, "studs", up=3, width=6)
    b.box("facade", (0, 6.15, 3.2), (14, 0.3, 6.4), matte(brick_texture(1400, 3060, rng, 48)), wall_T)
    b.box(
        "facade_l",
        (-8.6, 5.2, 2.2),
        (3.2, 2, 4.4),
        matte(brick_texture(800, 1000, rng, 32, c=(168, 140, 104))),
        temperature_field(26, rng, 0.5, up=2),
    )
    b.box(
        "shed",
        (8.7, 4.6, 1.6),
        (3.4, 3, 3.2),
        matte(planks_texture(900, 900, rng, 18)),
        temperature_field(31, rng, 0.6, up=2),
    )
    b.box(
        "plinth",
        (0, 5.96, 0.3),
        (14, 0.1, 0.6),
        matte(mottle((128, 124, 116), 120, 2000, rng, 0.35, 12)),
        temperature_field(23, rng, 0.4, up=2),
    )
    b.box(
        "plaster",
        (-4.9, 5.97, 1.95),
        (2.7, 0.06, 2.6),
        matte(mottle((206, 190, 158), 600, 620, rng, 0.22, 10)),
        hidden_heat_field(25, 38, rng),
        disc="hidden_heat",
        about="plain render with a buried hot-water loop",
    )
    for i, (x, z, w, h) in enumerate(
        ((-4.9, 4.7, 1.7, 1.5), (-1.7, 4.7, 1.7, 1.5), (1.7, 4.7, 1.7, 1.5), (4.9, 4.7, 1.7, 1.5), (1.9, 1.9, 2.0, 1.7))
    ):
        b.box(
            f"curtain{i}",
            (x, 5.985, z),
            (w, 0.02, h),
            matte(poster_texture(420, 480, rng, "OPEN") if i == 4 else books_texture(420, 480, rng)),
            temperature_field(23, rng, 0.4),
        )
        b.glass(
            f"window{i}",
            (x, 5.85, z),
            (w, h),
            temperature_field(24, rng, 0.3, spots=[(0.5, 0.1, 0.3, 1)]),
            about="facade window before a textured interior",
        )
        for k, (dx, dz, sx, sz) in enumerate(
            (
                (-w / 2, 0, 0.08, h),
                (w / 2, 0, 0.08, h),
                (0, -h / 2, w + 0.1, 0.08),
                (0, h / 2, w + 0.1, 0.08),
                (0, 0, 0.05, h),
            )
        ):
            b.box(
                f"frame{i}_{k}",
                (x + dx, 5.88, z + dz),
                (sx, 0.22, sz),
                matte((226, 224, 214)),
                temperature_field(26, rng, 0.2),
            )
    b.box(
        "door",
        (-0.65, 5.95, 1.15),
        (1.1, 0.12, 2.3),
        matte(panel_texture(900, 430, rng, (42, 84, 66), "No. 8")),
        temperature_field(28, rng, 0.3, up=3),
    )
    b.poster("billboard", (4.75, 5.95, 2.1), (2.2, 1.9), 26.5, "CINEMA", about="large printed board")
    b.tube(
        "downpipe",
        [(-2.95, 5.93, 6.3), (-2.95, 5.93, 0.15)],
        0.06,
        matte(brick_texture(200, 400, rng, 8)),
        temperature_field(41, rng, 0.3, right=-9),
        disc="hidden_heat",
        about="brick-coloured pipe carrying warm water",
    )
    _add_car(b)
    _add_street(b)
    return b, lambda n, r: camera_arc(n, r, (0, 3.9, 1.55), 8.6, 2.2, -139, -41, 0.9, jit=0.02, slide=1.0)


def _add_car(b: Builder) -> None:
    """Body, hot hood, cabin, glass, wheels."""
    rng = b.rng
    cx, cy, red = -1.6, 2.55, (158, 28, 30)
    b.box(
        "car_body",
        (cx, cy, 0.63),
        (4.0, 1.7, 0.56),
        gloss(decal_texture(300, 1800, rng, red, "CITY COURIER 24")),
        temperature_field(39, rng, 0.4, spots=[(0.85, 0.6, 0.12, 14)]),
    )
    b.box(
        "car_hood",
        (cx + 1.42, cy, 0.935),
        (1.12, 1.6, 0.07),
        gloss(mottle(red, 300, 300, rng, 0.12, 2)),
        temperature_field(56, rng, 0.4, spots=[(0.5, 0.5, 0.2, 16)]),
        about="hood over the hot engine",
    )
    b.add(
        "car_cabin",
        mesh_prism([(cx - 1.85, 0.9), (cx + 0.72, 0.9), (cx + 0.22, 1.45), (cx - 1.55, 1.45)], cy - 0.76, cy + 0.76),
        gloss(decal_texture(300, 700, rng, (228, 226, 218), "EXPRESS")),
        temperature_field(42, rng, 0.3),
        disc="specular",
        about="glossy paint",
    )
    for s in (-1, 1):
        b.add(
            f"car_side{s + 1}",
            mesh_prism(
                [(cx - 1.4, 0.98), (cx + 0.45, 0.98), (cx + 0.12, 1.37), (cx - 1.3, 1.37)],
                cy + s * 0.77 - 0.006,
                cy + s * 0.77 + 0.006,
            ),
            gloss((14, 17, 20)),
            temperature_field(34, rng, 0.3),
            eps=0.86,
            mirror=0,
        )
    b.box(
        "windscreen",
        (cx + 0.49, cy, 1.18),
        (0.02, 1.4, 0.62),
        gloss((14, 17, 20)),
        temperature_field(35, rng, 0.3),
        ry=-42,
        eps=0.86,
        mirror=0,
    )
    for i, (dx, s) in enumerate(((-1.25, -1), (-1.25, 1), (1.3, -1), (1.3, 1))):
        b.cyl(
            f"tyre{i}",
            (cx + dx, cy + (0.87 if s > 0 else -0.67), 0.33),
            0.33,
            0.2,
            matte(mottle((34, 34, 35), 128, 256, rng, 0.4, 8)),
            temperature_field(38, rng, 0.4),
            rx=90,
        )
        b.cyl(
            f"hub{i}",
            (cx + dx, cy + (0.89 if s > 0 else -0.86), 0.33),
            0.19,
            0.03,
            metal("Al", 0.12),
            temperature_field(41, rng),
            rx=90,
            eps=0.3,
            mirror=0,
        )
    b.box(
        "plate",
        (cx + 2.005, cy, 0.5),
        (0.02, 0.55, 0.14),
        matte(decal_texture(120, 480, rng, (230, 225, 90), "RGB T7")),
        temperature_field(36, rng),
    )
    b.tube(
        "exhaust",
        [(cx - 1.7, cy - 0.5, 0.25), (cx - 2.1, cy - 0.5, 0.25)],
        0.05,
        matte((70, 64, 60)),
        temperature_field(92, rng),
    )


def _add_street(b: Builder) -> None:
    """A generator behind a tarpaulin, bins, plants."""
    rng = b.rng
    b.box(
        "generator",
        (3.6, 4.2, 0.5),
        (1.1, 0.7, 0.9),
        matte(panel_texture(400, 520, rng, (196, 150, 40), "GEN 12kW")),
        temperature_field(58, rng, 0.4, up=8, spots=[(0.7, 0.6, 0.14, 34)]),
        about="running generator behind the tarpaulin",
    )
    b.plastic("tarp", (3.5, 3.55, 0.95), (1.9, 1.8), 27, rz=4, about="black tarpaulin before the generator")
    for s in (-1, 1):
        b.cyl(
            f"tarp_post{s + 1}",
            (3.5 + s * 0.95, 3.55 + s * 0.07, 0),
            0.03,
            1.95,
            matte((170, 168, 160)),
            temperature_field(29, rng),
        )
    b.ball(
        "bollard",
        (1.35, 2.3, 0.78),
        0.22,
        metal("Cr"),
        temperature_field(27, rng),
        eps=0.12,
        mirror=0,
        disc="specular",
        about="chrome globe",
    )
    b.cyl(
        "bollard_post",
        (1.35, 2.3, 0),
        0.09,
        0.58,
        matte(tiles_texture(300, 200, rng, 6, ((220, 200, 40), (30, 30, 30)), 1)),
        temperature_field(31, rng),
    )
    for i, c in enumerate(((40, 96, 60), (44, 70, 120))):
        b.box(
            f"bin{i}",
            (-5.6 + 0.75 * i, 4.9, 0.55),
            (0.6, 0.7, 1.1),
            matte(decal_texture(500, 300, rng, c, "GLASS" if i else "PAPER")),
            temperature_field(33, rng, 0.4, up=3),
        )
    b.box(
        "planter",
        (-6.0, 2.6, 0.3),
        (1.0, 2.2, 0.6),
        matte(planks_texture(300, 700, rng, 6)),
        temperature_field(27, rng),
    )
    b.leaves(
        "bush",
        (-6.0, 2.6, 1.0),
        (0.55, 1.1, 0.55),
        420,
        0.22,
        matte(leafwall_texture(512, 512, rng)),
        temperature_field(21, rng, 0.4),
        eps=0.96,
    )
    b.tube(
        "trunk",
        [(6.2, 3.2, 0), (6.25, 3.25, 1.4), (6.1, 3.2, 2.9)],
        0.16,
        matte(foliage_texture(400, 400, rng, (92, 74, 56))),
        temperature_field(24, rng, 0.4),
        bend=0.6,
    )
    b.leaves(
        "crown",
        (6.1, 3.2, 3.6),
        (1.3, 1.3, 1.1),
        620,
        0.30,
        matte(leafwall_texture(512, 512, rng)),
        temperature_field(21.5, rng, 0.5),
        eps=0.96,
    )
    b.box(
        "hedge",
        (0, 9.4, 4),
        (26, 0.4, 8),
        matte(leafwall_texture(700, 2200, rng)),
        temperature_field(20, rng, 0.7),
    )
    b.box(
        "crate0",
        (5.6, 1.9, 0.35),
        (0.8, 0.7, 0.7),
        matte(planks_texture(400, 400, rng, 5)),
        temperature_field(31, rng, 0.4),
        rz=25,
    )
    b.ball(
        "boulder",
        (-3.9, 0.4, 0.25),
        0.42,
        matte(mottle((140, 132, 120), 300, 500, rng, 0.5, 14)),
        temperature_field(35, rng, 0.5),
        rough=0.12,
    )
