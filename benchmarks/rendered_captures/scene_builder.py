"""A scene: objects with a shape, a look, a temperature and thermal properties."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendered_captures.materials import clear, matte
from rendered_captures.meshes.mesh import Mesh, move
from rendered_captures.meshes.solids import mesh_ball, mesh_box, mesh_cyl, mesh_face
from rendered_captures.meshes.swept import densify, fillet, mesh_leaves, mesh_tube
from rendered_captures.temperature_fields import temperature_field
from rendered_captures.textures.noise import mottle
from rendered_captures.textures.prints import poster_texture

LABELS = {"glass": 1, "poster": 2, "hidden_heat": 3, "plastic": 4, "specular": 5}
"""What photographs and thermal images disagree on: glass is clear to light alone, a poster is patterned to light
alone, hidden heat shows in thermal images alone, plastic film is clear to heat alone, and a specular surface mirrors.
"""
Field = float | NDArray[np.float32]


@dataclass
class Object:
    """A thing in the scene."""

    name: str
    mesh: Mesh
    rgb: dict[str, Any]
    """Its surface in light."""
    T: Field
    """[deg C], one or a texture."""
    eps: float
    """Emissivity."""
    mirror: float | None
    """Thermal reflection: None diffuse, 0 a mirror, more: its roughness."""
    tau: float
    """Thermal transmittance of both faces together."""
    disc: str | None
    """Key of ``LABELS``."""
    emit: tuple[float, float, float] | None
    """Radiance of a lamp, linear."""
    mesh_rgb: Mesh | None = None
    """The shape in light, where it is another one."""
    about: str = ""


class Builder:
    """Collects objects.

    Args:
        rng: Draws textures and temperatures; the order of calls is part of a scene.
        room_T: Temperature of what has none of its own [deg C].
    """

    def __init__(self, rng: np.random.Generator, room_T: float = 21.0) -> None:
        self.rng, self.room_T = rng, room_T
        self.objs: list[Object] = []
        self.env_rgb: NDArray[np.float32] | None = None
        self.env_T: NDArray[Any] | None = None
        self.sun: tuple[tuple[float, ...], tuple[float, ...]] | None = None
        self.fov, self.key = 55.0, 0.16
        """Field of view across [degrees], and the geometric mean of a developed photograph's linear values."""

    def add(
        self,
        name: str,
        mesh: Mesh,
        rgb: dict[str, Any],
        T: Field | None = None,
        eps: float = 0.93,
        mirror: float | None = None,
        tau: float = 0.0,
        disc: str | None = None,
        emit: tuple[float, float, float] | None = None,
        mesh_rgb: Mesh | None = None,
        about: str = "",
    ) -> None:
        """Add an object: the fields of ``Object``; without a temperature it has about that of the room."""
        T = temperature_field(self.room_T, self.rng) if T is None else T
        self.objs.append(Object(name, mesh, rgb, T, eps, mirror, tau, disc, emit, mesh_rgb, about))

    def box(
        self,
        name: str,
        c: Sequence[float],
        s: Sequence[float],
        rgb: dict[str, Any],
        T: Field | None = None,
        rz: float = 0,
        rx: float = 0,
        ry: float = 0,
        **k: Any,
    ) -> None:
        """A box of size ``s`` about ``c``, turned by degrees."""
        self.add(name, move(mesh_box(s), c, rz, rx, ry), rgb, T, **k)

    def cyl(
        self,
        name: str,
        c: Sequence[float],
        r: float,
        h: float,
        rgb: dict[str, Any],
        T: Field | None = None,
        rx: float = 0,
        **k: Any,
    ) -> None:
        """A cylinder of height ``h`` that stands on ``c``."""
        self.add(name, move(mesh_cyl(r, h), c, rx=rx), rgb, T, **k)

    def tube(
        self,
        name: str,
        pts: Sequence[Sequence[float]],
        r: float,
        rgb: dict[str, Any],
        T: Field | None = None,
        bend: float = 0.08,
        **k: Any,
    ) -> None:
        """A pipe along points, its bends rounded."""
        self.add(name, mesh_tube(fillet(pts, bend) if len(pts) > 2 else densify(pts), r), rgb, T, **k)

    def ball(
        self,
        name: str,
        c: Sequence[float],
        r: float,
        rgb: dict[str, Any],
        T: Field | None = None,
        rough: float = 0.0,
        **k: Any,
    ) -> None:
        """A ball, or a boulder where it is rough."""
        self.add(name, move(mesh_ball(r, self.rng, rough), c), rgb, T, **k)

    def leaves(
        self,
        name: str,
        c: Sequence[float],
        r: Sequence[float],
        n: int,
        size: float,
        rgb: dict[str, Any],
        T: Field | None = None,
        **k: Any,
    ) -> None:
        """A cloud of ``n`` leaves."""
        self.add(name, mesh_leaves(c, r, n, size, self.rng), rgb, T, **k)

    def glass(
        self, name: str, c: Sequence[float], s: Sequence[float], T: Field, rz: float = 0, about: str = ""
    ) -> None:
        """Pane of width s[0], height s[1]: clear sheet in RGB; eps .86 + .14 mirror in thermal."""
        q = mesh_box((s[0], 0.006, s[1]))
        face = mesh_face((s[0], 0.006, s[1]), 3)
        q1 = face._replace(vertices=face.vertices * (1, 0, 1))
        self.add(
            name,
            move(q, c, rz),
            clear(),
            T,
            eps=0.86,
            mirror=0,
            disc="glass",
            mesh_rgb=move(q1, c, rz),
            about=about,
        )

    def plastic(
        self, name: str, c: Sequence[float], s: Sequence[float], T: Field, rz: float = 0, about: str = ""
    ) -> None:
        """Thin dark polyethylene-like sheet: satin black in RGB; tau .82 (both faces together), eps .18 in thermal."""
        tex = mottle((22, 22, 25), 256, 256, self.rng, 0.35, 3)
        self.add(
            name,
            move(mesh_box((s[0], 0.003, s[1])), c, rz),
            matte(tex),
            T,
            eps=0.18,
            tau=0.82,
            disc="plastic",
            about=about,
        )

    def poster(
        self, name: str, c: Sequence[float], s: Sequence[float], T: float, title: str, rz: float = 0, about: str = ""
    ) -> None:
        """A poster at one temperature."""
        h = int(900 * s[1] / max(s))
        w = int(900 * s[0] / max(s))
        self.box(
            name,
            c,
            (s[0], 0.012, s[1]),
            matte(poster_texture(h, w, self.rng, title)),
            float(T),
            rz=rz,
            disc="poster",
            about=about,
        )
