"""Closed rooms and what stands in them."""

from collections.abc import Sequence
from typing import Any

from rendered_captures.materials import gloss, matte
from rendered_captures.meshes.mesh import move
from rendered_captures.meshes.solids import mesh_face, mesh_lathe
from rendered_captures.scene_builder import Builder, Field
from rendered_captures.temperature_fields import hidden_heat_field, temperature_field
from rendered_captures.textures.noise import Bytes, Color, mottle
from rendered_captures.textures.surfaces import foliage_texture


def room(
    b: Builder,
    x0: float,
    x1: float,
    y0: float,
    y1: float,
    h: float,
    wall: Color,
    floor: Bytes,
    lights: Sequence[tuple[float, float, float, float]],
    light_rad: float,
    hidden: tuple[str, str, float],
) -> None:
    """Six textured slabs with thermal stratification; `hidden` = (wall name, kind, hot) puts heat behind that wall."""
    r, cx, cy, t = b.rng, (x0 + x1) / 2, (y0 + y1) / 2, 0.1

    def paint(w: float) -> dict[str, Any]:
        return matte(mottle(wall, int(1400 * h / max(w, h)), 1400, r, 0.17, 6, 5, 7))

    def warmth(k: str) -> Field:
        if hidden[0] == k:
            return hidden_heat_field(b.room_T, hidden[2], r, hidden[1], up=2.2)
        return temperature_field(b.room_T, r, 0.35, up=2.2)

    def tag(k: str) -> dict[str, Any]:
        return dict(disc="hidden_heat", about="heating loop behind plain painted wall") if hidden[0] == k else {}

    b.box("wall_n", (cx, y1 + t / 2, h / 2), (x1 - x0 + 2 * t, t, h), paint(x1 - x0), warmth("wall_n"), **tag("wall_n"))
    b.box("wall_s", (cx, y0 - t / 2, h / 2), (x1 - x0 + 2 * t, t, h), paint(x1 - x0), warmth("wall_s"), **tag("wall_s"))
    b.box("wall_w", (x0 - t / 2, cy, h / 2), (t, y1 - y0, h), paint(y1 - y0), warmth("wall_w"), **tag("wall_w"))
    b.box("wall_e", (x1 + t / 2, cy, h / 2), (t, y1 - y0, h), paint(y1 - y0), warmth("wall_e"), **tag("wall_e"))
    b.box("floor", (cx, cy, -t / 2), (x1 - x0, y1 - y0, t), matte(floor), temperature_field(b.room_T - 1.2, r, 0.4))
    b.box(
        "ceiling",
        (cx, cy, h + t / 2),
        (x1 - x0, y1 - y0, t),
        matte(mottle((226, 224, 218), 512, 512, r, 0.06, 3)),
        temperature_field(b.room_T + 1.5, r, 0.3),
    )
    for i, (lx, ly, sx, sy) in enumerate(lights):
        b.box(
            f"lamp{i}",
            (lx, ly, h - 0.02),
            (sx, sy, 0.03),
            matte((200, 200, 200)),
            36.0,
            emit=(light_rad, light_rad * 0.98, light_rad * 0.93),
            mesh_rgb=move(mesh_face((sx, sy, 0.03), 5), (lx, ly, h - 0.02)),
        )


def pot_plant(b: Builder, name: str, x: float, y: float, z: float, r: float, n: int, leaf: float) -> None:
    """A plant in a glossy pot of radius ``r``."""
    b.add(
        name + "_pot",
        move(
            mesh_lathe(
                [
                    (0.6 * r, 0),
                    (0.95 * r, 0.6 * r),
                    (r, 1.3 * r),
                    (0.85 * r, 1.3 * r),
                    (0.8 * r, 1.1 * r),
                    (1e-4, 1.1 * r),
                ]
            ),
            (x, y, z),
        ),
        gloss((178, 58, 40)),
        temperature_field(20.5, b.rng),
        disc="specular",
        about="glossy glazed pot",
    )
    b.leaves(
        name + "_leaves",
        (x, y, z + 2.5 * r),
        (1.25 * r, 1.25 * r, 1.2 * r),
        n,
        leaf,
        matte(foliage_texture(256, 256, b.rng)),
        temperature_field(20.0, b.rng, 0.4),
        eps=0.96,
    )
