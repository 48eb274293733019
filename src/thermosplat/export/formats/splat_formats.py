"""The formats of splats by name: how their files end, and what writes them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from thermosplat.errors import UserError
from thermosplat.export.formats.compressed_ply import write_compressed_ply
from thermosplat.export.formats.glb import write_glb
from thermosplat.export.formats.ply import write_splats
from thermosplat.export.formats.sog import write_sog
from thermosplat.export.formats.spz import write_spz
from thermosplat.export.formats.usd import write_usd
from thermosplat.export.splats import Splats, WrittenSplats, used_coefficients

SplatFormat = Literal["ply", "compressed-ply", "spz", "sog", "glb", "usd"]
SPLAT_FORMATS: tuple[SplatFormat, ...] = get_args(SplatFormat)


@dataclass(frozen=True)
class Described:
    """Splats with what their file shall say about them."""

    splats: Splats
    spectrum: str
    comments: Sequence[str] = ()
    """For the header, where the format has room for text."""


HELD_DEGREES = {"compressed-ply": 3, "spz": 3, "sog": 3, "glb": 3, "html": 3}
"""Highest degree of spherical harmonics that a format has room for, where there is a limit."""

_WRITERS: dict[SplatFormat, tuple[str, Callable[[Path, Described], WrittenSplats]]] = {
    "ply": (".ply", lambda path, scene: write_splats(path, scene.splats, scene.comments)),
    "compressed-ply": (
        ".compressed.ply",
        lambda path, scene: write_compressed_ply(path, scene.splats, scene.comments),
    ),
    "spz": (".spz", lambda path, scene: write_spz(path, scene.splats)),
    "sog": (".sog", lambda path, scene: write_sog(path, scene.splats)),
    "glb": (".glb", lambda path, scene: write_glb(path, scene.splats, name=f"splat_{scene.spectrum}")),
    "usd": (".usd", lambda path, scene: write_usd(path, scene.splats, name=f"splat_{scene.spectrum}")),
}


def write_format(format: SplatFormat, folder: Path, scene: Described) -> WrittenSplats:
    """Write ``splat_<spectrum>`` in a format; the file appears at once and whole.

    Raises:
        UserError: The format cannot hold the scene, or what writes it is not installed.
    """
    check_degree(format, scene.spectrum, scene.splats)
    suffix, write = _WRITERS[format]
    return write(folder / f"splat_{scene.spectrum}{suffix}", scene)


def check_degree(format: str, spectrum: str, splats: Splats) -> None:
    """Refuse harmonics that a format has no room for.

    Raises:
        UserError: They use more.
    """
    held, used = HELD_DEGREES.get(format), int((used_coefficients(splats.shN) + 1) ** 0.5) - 1
    if held is not None and used > held:
        raise UserError(
            f"{format} holds spherical harmonics up to degree {held}, the Gaussians of {spectrum} use {used}.",
            "Export with --format ply or usd, or train with --sh-degree 3.",
        )
