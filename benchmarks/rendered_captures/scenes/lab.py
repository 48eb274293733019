"""A laboratory: hot plate behind a sash, furnace behind a curtain, pipes, a cold dewar."""

import numpy as np

from rendered_captures.materials import gloss, matte, metal
from rendered_captures.meshes.mesh import move
from rendered_captures.meshes.solids import mesh_lathe
from rendered_captures.paths import CameraPath, camera_arc
from rendered_captures.scene_builder import Builder
from rendered_captures.scenes.furniture import pot_plant, room
from rendered_captures.temperature_fields import temperature_field
from rendered_captures.textures.noise import mottle
from rendered_captures.textures.prints import WORDS, decal_texture, panel_texture, screen_texture
from rendered_captures.textures.surfaces import planks_texture, tiles_texture, wood_texture


def lab(rng: np.random.Generator) -> tuple[Builder, CameraPath]:
    """The scene, and where its cameras go."""
    b = Builder(rng, 22.0)
    b.fov = 66
    room(
        b,
        -2.4,
        2.6,
        -2.8,
        2.4,
        2.8,
        (196, 206, 200),
        tiles_texture(1600, 1600, rng, 16, ((196, 198, 194), (120, 140, 150))),
        [(-0.8, 0.2, 1.6, 0.9), (1.3, -0.4, 1.6, 0.9)],
        6,
        hidden=("wall_n", "tree", 34.0),
    )
    b.poster("poster0", (-0.95, 2.38, 1.75), (0.8, 1.0), 21.7, "SAFETY")
    b.poster("poster1", (0.15, 2.38, 1.85), (1.05, 0.8), 21.9, "SPECTRA", about="wide wall chart")
    b.poster("poster2", (-2.38, -0.1, 1.75), (0.9, 1.1), 22.0, "VALVES", rz=90)
    b.box(
        "bench",
        (0.35, 2.02, 0.44),
        (3.6, 0.70, 0.88),
        matte(panel_texture(420, 1700, rng, (172, 150, 118), "STORE B")),
        temperature_field(21.6, rng, 0.3, up=1.0),
    )
    b.box(
        "benchtop",
        (0.35, 2.0, 0.90),
        (3.7, 0.78, 0.04),
        matte(mottle((66, 70, 74), 300, 1400, rng, 0.35, 9)),
        temperature_field(22.2, rng, 0.3, spots=[(0.27, 0.5, 0.07, 9), (0.62, 0.5, 0.05, 4)]),
    )
    b.box(
        "shelf", (1.6, 2.24, 1.55), (1.5, 0.3, 0.03), matte(wood_texture(200, 900, rng)), temperature_field(22.6, rng)
    )
    for i in range(7):
        b.box(
            f"carton{i}",
            (1.0 + 0.2 * i, 2.24, 1.565 + 0.11 + 0.03 * (i % 3)),
            (0.17, 0.2, 0.22 + 0.06 * (i % 3)),
            matte(decal_texture(300, 260, rng, tuple(rng.integers(60, 220, 3)), WORDS[i].upper())),
            temperature_field(22.7, rng),
        )
    b.box(
        "scope",
        (1.45, 2.0, 1.07),
        (0.46, 0.34, 0.30),
        matte(panel_texture(420, 640, rng, (205, 200, 186), "SCOPE 4")),
        temperature_field(28, rng, 0.3, up=6, spots=[(0.8, 0.8, 0.15, 4)]),
    )
    b.box(
        "supply",
        (1.95, 2.0, 1.03),
        (0.34, 0.34, 0.22),
        matte(panel_texture(320, 500, rng, (70, 84, 100), "PSU")),
        temperature_field(31, rng, 0.3, up=8),
    )
    b.box(
        "monitor",
        (0.75, 2.12, 1.22),
        (0.62, 0.04, 0.38),
        matte(screen_texture(500, 820, rng)),
        temperature_field(30, rng, 0.3, up=5),
    )
    b.box("monitor_stand", (0.75, 2.15, 0.97), (0.08, 0.06, 0.12), matte((30, 30, 32)))
    b.box(
        "hotplate",
        (-0.62, 2.0, 0.96),
        (0.30, 0.30, 0.08),
        matte(panel_texture(120, 300, rng, (220, 220, 215), "HOT")),
        temperature_field(38, rng, 0.3, up=14),
    )
    b.cyl("plate", (-0.62, 2.0, 1.0), 0.12, 0.012, matte((210, 208, 200)), temperature_field(70, rng, 0.5))
    b.add(
        "beaker",
        move(
            mesh_lathe([(0.07, 0), (0.075, 0.01), (0.075, 0.17), (0.07, 0.17), (0.068, 0.15), (1e-4, 0.15)]),
            (-0.62, 2.0, 1.012),
        ),
        gloss(decal_texture(260, 500, rng, (60, 130, 190), "500 ml")),
        temperature_field(58, rng, 0.3, up=-6),
    )
    for i, c in enumerate(((150, 70, 20), (40, 120, 60), (190, 170, 40), (120, 40, 110))):
        b.add(
            f"bottle{i}",
            move(
                mesh_lathe([(0.045, 0), (0.05, 0.01), (0.05, 0.15), (0.018, 0.2), (0.018, 0.25), (1e-4, 0.25)]),
                (-1.05 + 0.12 * i * (1 if i < 2 else 1.9), 2.12, 0.92),
            ),
            gloss(decal_texture(300, 500, rng, c, WORDS[i + 9])),
            temperature_field(21.8, rng, 0.15),
            disc="specular",
            about="glossy bottle",
        )
    b.glass(
        "hood",
        (-0.68, 1.70, 1.24),
        (1.10, 0.62),
        temperature_field(23.0, rng, 0.2, spots=[(0.5, 0.3, 0.2, 2.5)]),
        about="fume-hood sash before hot plate, beaker and bottles",
    )
    for i, x in enumerate((-1.24, -0.12)):
        b.box(f"hood_post{i}", (x, 1.70, 1.26), (0.03, 0.04, 0.70), matte((200, 60, 40)))
    b.box("hood_top", (-0.68, 1.70, 1.62), (1.2, 0.05, 0.05), matte((200, 60, 40)), temperature_field(24, rng))
    b.box(
        "oven",
        (-1.95, 1.0, 0.55),
        (0.75, 0.9, 1.1),
        matte(panel_texture(800, 700, rng, (168, 168, 160), "FURNACE")),
        temperature_field(42, rng, 0.4, up=6, spots=[(0.5, 0.5, 0.2, 26)]),
        about="hot oven, half behind the plastic curtain",
    )
    b.plastic("curtain", (-1.48, 0.34, 0.68), (0.80, 1.25), 22.3, rz=32, about="black curtain in front of the furnace")
    b.tube(
        "curtain_rail",
        [(-1.84, 0.115, 1.32), (-1.12, 0.565, 1.32)],
        0.012,
        metal("Al", 0.2),
        temperature_field(22, rng),
        eps=0.25,
        mirror=0,
    )
    wall_paint = mottle((196, 206, 200), 128, 700, rng, 0.17, 6)
    for i, (z, t) in enumerate(((2.05, 52), (2.22, 41), (2.39, 13))):
        b.tube(
            f"pipe{i}",
            [
                (-2.34 + 0.02, -1.6, z),
                (-2.32, 2.30 - 0.05 * i, z),
                (-0.2 + 0.6 * i, 2.32, z),
                (-0.2 + 0.6 * i, 2.32, 2.8),
            ],
            0.035,
            matte(wall_paint),
            temperature_field(t, rng, 0.3, right=-8 if t > 30 else 3),
            disc="hidden_heat",
            about="wall-coloured pipe, hot or cold",
        )
    b.add(
        "dewar",
        move(
            mesh_lathe(
                [(0.10, 0), (0.15, 0.03), (0.16, 0.34), (0.12, 0.44), (0.05, 0.50), (0.05, 0.58), (1e-4, 0.58)], 96
            ),
            (1.75, 1.0, 0),
        ),
        metal("Al", 0.06),
        temperature_field(8, rng, 0.5),
        eps=0.15,
        mirror=0,
        disc="specular",
        about="polished cold dewar",
    )
    for i, c in enumerate(((160, 30, 30), (30, 70, 150))):
        b.add(
            f"gas{i}",
            move(
                mesh_lathe(
                    [(0.12, 0), (0.13, 0.02), (0.13, 1.2), (0.09, 1.34), (0.03, 1.38), (0.03, 1.46), (1e-4, 1.46)]
                ),
                (2.32, 1.5 - 0.36 * i, 0),
            ),
            gloss(decal_texture(500, 400, rng, c, "N2" if i else "ARGON")),
            temperature_field(20.5 + i, rng, 0.2, up=1.5),
        )
    b.cyl(
        "stool",
        (0.55, 0.95, 0.55),
        0.18,
        0.05,
        matte(decal_texture(200, 400, rng, (120, 40, 40), "seat")),
        temperature_field(25.5, rng, 0.3, spots=[(0.5, 0.85, 0.3, 5)]),
    )
    b.cyl("stool_leg", (0.55, 0.95, 0), 0.03, 0.55, metal("Cr", 0.1), temperature_field(22, rng), eps=0.2, mirror=0)
    b.ball(
        "float",
        (0.05, 1.85, 1.0),
        0.08,
        metal("Cr"),
        temperature_field(22.5, rng),
        eps=0.12,
        mirror=0,
        disc="specular",
        about="chrome ball on the bench",
    )
    pot_plant(b, "plant", 2.05, 1.95, 0.92, 0.10, 110, 0.09)
    b.box(
        "crate",
        (-0.6, 1.15, 0.2),
        (0.5, 0.36, 0.4),
        matte(planks_texture(300, 400, rng, 5)),
        temperature_field(21, rng),
        rz=18,
    )
    return b, lambda n, r: camera_arc(n, r, (-0.25, 1.6, 1.12), 3.3, 1.45, -120, -60, 0.38, slide=0.4)
