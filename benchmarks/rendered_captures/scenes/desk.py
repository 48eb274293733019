"""A round table with laptop, mug, glass pane, film and hidden heater, in a room."""

import numpy as np

from rendered_captures.materials import gloss, matte, metal
from rendered_captures.meshes.mesh import move, planar_uv
from rendered_captures.meshes.solids import mesh_lathe
from rendered_captures.paths import CameraPath, camera_orbit
from rendered_captures.scene_builder import Builder
from rendered_captures.scenes.furniture import pot_plant, room
from rendered_captures.temperature_fields import hidden_heat_field, temperature_field
from rendered_captures.textures.noise import mottle
from rendered_captures.textures.prints import (
    books_texture,
    decal_texture,
    keyboard_texture,
    panel_texture,
    poster_texture,
    screen_texture,
)
from rendered_captures.textures.surfaces import planks_texture, tiles_texture, wood_texture


def desk(rng: np.random.Generator) -> tuple[Builder, CameraPath]:
    """The scene, and where its cameras go."""
    b = Builder(rng, 21.5)
    b.fov, Z = 56, 0.75
    room(
        b,
        -2.3,
        2.3,
        -2.3,
        2.3,
        2.6,
        (214, 203, 178),
        planks_texture(1400, 1400, rng, 14),
        [(-0.9, 0.7, 1.1, 0.5), (0.9, -0.7, 1.1, 0.5)],
        10,
        hidden=("wall_e", "serpentine", 29.0),
    )
    b.poster("wallposter0", (-0.7, 2.28, 1.35), (1.0, 0.9), 20.8, "FARM")
    b.poster("wallposter1", (-2.28, -0.4, 1.35), (1.1, 0.85), 21.0, "LWIR", rz=90)
    b.poster("wallposter2", (0.5, -2.28, 1.3), (1.2, 0.9), 21.6, "NIGHT 8")
    b.poster("wallposter3", (2.28, 1.35, 1.4), (0.7, 0.9), 22.2, "DELTA", rz=90)
    b.box(
        "bookcase",
        (1.35, 2.1, 0.95),
        (1.2, 0.32, 1.9),
        matte(wood_texture(500, 400, rng)),
        temperature_field(21.2, rng, up=1),
    )
    for i in range(4):
        b.box(
            f"books{i}",
            (1.35, 1.935, 0.3 + 0.42 * i),
            (1.08, 0.03, 0.32),
            matte(books_texture(300, 1000, rng)),
            temperature_field(21.4 + 0.2 * i, rng),
        )
    b.box(
        "radiator",
        (-1.2, -2.2, 0.4),
        (1.1, 0.1, 0.55),
        matte(mottle((232, 230, 222), 300, 500, rng, 0.08, 2)),
        hidden_heat_field(37, 43, rng, "studs", up=5),
    )
    b.box(
        "sideboard",
        (-2.05, 1.2, 0.35),
        (0.45, 1.2, 0.7),
        matte(wood_texture(400, 700, rng, (70, 40, 22), (130, 86, 50))),
        temperature_field(20.9, rng),
    )
    pot_plant(b, "bigplant", -2.02, 1.2, 0.7, 0.17, 150, 0.13)
    b.box(
        "door",
        (1.6, -2.27, 1.0),
        (0.8, 0.05, 2.0),
        matte(panel_texture(1000, 420, rng, (150, 168, 176), "EXIT")),
        temperature_field(20.2, rng, up=2),
    )
    # the table and what stands on it
    b.add(
        "table",
        planar_uv(
            move(mesh_lathe([(1e-4, 0), (0.70, 0), (0.72, 0.015), (0.70, 0.03), (1e-4, 0.03)], 96), (0, 0, Z - 0.03))
        ),
        matte(wood_texture(900, 900, rng)),
        temperature_field(21.8, rng, 0.4),
    )
    b.box(
        "tablemat",
        (0, 0, Z + 0.002),
        (0.92, 0.92, 0.003),
        matte(tiles_texture(900, 900, rng, 12, ((206, 186, 150), (64, 96, 120), (178, 84, 60)))),
        temperature_field(
            22.0, rng, 0.2, spots=[(0.62, 0.30, 0.05, 7), (0.28, 0.60, 0.16, 3.5), (0.80, 0.78, 0.07, 6)]
        ),
    )
    b.cyl("table_leg", (0, 0, 0), 0.06, Z - 0.03, metal("Cr", 0.2), temperature_field(21, rng), eps=0.3, mirror=0)
    b.box(
        "laptop_base",
        (-0.22, 0.10, Z + 0.014),
        (0.34, 0.24, 0.018),
        matte(keyboard_texture(560, 800, rng)),
        temperature_field(29, rng, 0.3, up=9, spots=[(0.3, 0.75, 0.15, 5)]),
        rz=35,
    )
    b.box(
        "laptop_lid",
        (-0.295, 0.207, Z + 0.125),
        (0.34, 0.012, 0.22),
        matte(screen_texture(520, 800, rng)),
        temperature_field(31, rng, 0.4, up=-3),
        rz=35,
        rx=-14,
    )
    mug = mesh_lathe([(0.036, 0), (0.040, 0.006), (0.040, 0.095), (0.036, 0.095), (0.034, 0.085), (1e-4, 0.085)])
    b.add(
        "mug",
        move(mug, (0.12, -0.12, Z + 0.004)),
        gloss(poster_texture(300, 700, rng, "coffee")),
        temperature_field(41, rng, 0.4, up=6),
    )
    b.tube(
        "mug_handle",
        [(0.157, -0.14, Z + 0.075), (0.19, -0.155, Z + 0.075), (0.19, -0.155, Z + 0.03), (0.157, -0.14, Z + 0.03)],
        0.006,
        gloss((225, 220, 205)),
        temperature_field(33, rng),
        bend=0.02,
    )
    b.glass(
        "pane",
        (0.20, -0.27, Z + 0.18),
        (0.46, 0.32),
        temperature_field(22.5, rng, 0.2, spots=[(0.35, 0.3, 0.25, 2.0)]),
        rz=28,
        about="upright pane in front of mug and books",
    )
    for s in (-1, 1):
        b.box(
            f"pane_foot{s + 1}",
            (0.20 + s * 0.2 * np.cos(np.radians(28)), -0.27 + s * 0.2 * np.sin(np.radians(28)), Z + 0.012),
            (0.03, 0.09, 0.024),
            matte((40, 40, 44)),
            rz=28,
        )
    for i in range(5):
        b.box(
            f"bookstack{i}",
            (0.30, -0.05, Z + 0.022 + 0.032 * i),
            (0.19, 0.14, 0.031),
            matte(decal_texture(200, 300, rng, tuple(rng.integers(40, 225, 3)), f"VOL {i + 1}")),
            temperature_field(21.7, rng, 0.15),
            rz=float(rng.uniform(-25, 40)),
        )
    b.plastic(
        "sheet", (-0.18, -0.36, Z + 0.155), (0.36, 0.30), 21.8, rz=-28, about="black sheet hiding the heated flask"
    )
    b.box("sheet_foot", (-0.18, -0.36, Z + 0.006), (0.36, 0.03, 0.012), matte((60, 60, 60)), rz=-28)
    b.add(
        "flask",
        move(
            mesh_lathe([(0.045, 0), (0.05, 0.01), (0.05, 0.16), (0.025, 0.20), (0.025, 0.23), (1e-4, 0.23)]),
            (-0.12, -0.24, Z + 0.004),
        ),
        matte(decal_texture(300, 500, rng, (52, 82, 140), "HEAT")),
        temperature_field(46, rng, 0.3, up=-10),
        about="hot flask behind the sheet",
    )
    b.box(
        "panel",
        (0.20, 0.33, Z + 0.165),
        (0.40, 0.03, 0.32),
        matte(mottle((206, 200, 186), 420, 520, rng, 0.2, 9)),
        hidden_heat_field(23.5, 36, rng),
        rz=-30,
        disc="hidden_heat",
        about="plain board with a buried heating loop",
    )
    b.box("panel_foot", (0.20, 0.33, Z + 0.008), (0.3, 0.12, 0.012), matte((80, 76, 70)), rz=-30)
    b.poster("minposter", (-0.33, -0.08, Z + 0.145), (0.24, 0.28), 21.9, "Kestrel", rz=80, about="standing card")
    b.ball(
        "chrome",
        (0.02, 0.20, Z + 0.068),
        0.065,
        metal("Cr"),
        temperature_field(22.5, rng, 0.2),
        eps=0.12,
        mirror=0,
        disc="specular",
        about="chrome ball",
    )
    b.box(
        "cube",
        (0.44, 0.12, Z + 0.05),
        (0.09, 0.09, 0.09),
        matte(tiles_texture(400, 400, rng, 4, ((210, 40, 40), (240, 200, 40), (40, 80, 190), (240, 240, 235)), 8)),
        temperature_field(21.6, rng),
        rz=20,
    )
    pot_plant(b, "plant", -0.03, 0.45, Z + 0.004, 0.06, 90, 0.05)
    b.cyl(
        "solder_can",
        (0.43, -0.20, Z + 0.004),
        0.035,
        0.11,
        matte(decal_texture(300, 600, rng, (190, 150, 40), "FLUX")),
        temperature_field(34, rng, 0.3, up=6),
    )
    b.box(
        "phone",
        (-0.06, -0.08, Z + 0.012),
        (0.075, 0.15, 0.009),
        gloss(screen_texture(600, 300, rng)),
        temperature_field(27, rng, 0.3, up=3),
        rz=-15,
    )
    return b, lambda n, r: camera_orbit(n, r, (0, 0, Z + 0.10), 1.32, 1.30, 0.17, 3)
