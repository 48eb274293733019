"""The page as one file: the scene's bytes, what is known of it, and the scripts that draw it.

A policy in the page forbids whatever is not in it: scripts and styles are named by their hashes, and nothing may be
loaded from anywhere. Texts of strangers are data for the scripts, which never take text for HTML.
"""

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from thermosplat.export.page.packed_splats import packed
from thermosplat.export.splats import Splats
from thermosplat.pictures.display_palettes import DISPLAY_PALETTES, display_palette
from thermosplat.printing import printable
from thermosplat.thermal.radiometry import Palette

SCRIPTS = ("unpack.js", "renderer.js", "camera.js", "measuring.js", "main.js")
Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class PageLayer:
    """A spectrum."""

    key: str
    name: str
    splats: Splats
    """In the page's frame; of a spectrum of values their colours are its intensity."""
    is_value: bool
    background: Vector
    """What is behind the splats, in [0, 1]."""
    range: tuple[float, float] = (0.0, 1.0)
    """Values that intensities 0 and 1 stand for."""
    shown: tuple[float, float] = (0.0, 1.0)
    """Values at the palette's ends, to begin with."""
    unit: str = ""
    decimals: int = 3


@dataclass(frozen=True)
class PageScene:
    """What the page knows beside the splats. Its frame is the world of the capture, counted from ``origin``."""

    title: str
    views: Sequence[dict[str, Any]]
    """Name, viewmat and fov of the capture's views."""
    start: int
    """Of the views, the first to show."""
    up: Vector
    focus: Vector
    """What the views look at."""
    spacing: float
    """Between views: what a step is [world units]."""
    origin: Vector = (0.0, 0.0, 0.0)
    metres: float | None = None
    """Length of a world unit [m]; None: nobody knows it."""
    marks: Sequence[dict[str, Any]] = field(default_factory=tuple)
    """Kind, name, text and points of findings and measurements."""


def page_of(scene: PageScene, layers: Sequence[PageLayer], palette: Palette) -> str:
    """The file's text.

    Args:
        layers: Its spectra, at least one.
    """
    room = files(__package__)
    script = '"use strict";\n(() => {\n' + "".join(room.joinpath(name).read_text("utf-8") for name in SCRIPTS) + "})();"
    style = room.joinpath("page.css").read_text("utf-8")
    described, parts = [], []
    for number, layer in enumerate(layers):
        about, content = packed(layer.splats, 1 if layer.is_value else 3)
        described.append(
            {"key": layer.key, "name": layer.name, "splats": about, "back": layer.background, "range": layer.range}
            | {"shown": layer.shown, "unit": layer.unit, "decimals": layer.decimals}
        )
        parts.append(f'<script type="text/plain" id="splats{number}">{base64.b64encode(content).decode()}</script>')
    palettes = [("the capture's", palette), *((name, display_palette(name)) for name in DISPLAY_PALETTES)]
    known = {name: getattr(scene, name) for name in ("title", "views", "start", "up", "focus", "spacing", "origin")}
    known |= {"metres": scene.metres, "layers": described}
    known["palettes"] = [{"name": name, "colors": _levels(one)} for name, one in palettes]
    allowed = f"script-src {_hash(script)}; style-src {_hash(style)}; base-uri 'none'; form-action 'none'"
    words = {
        "POLICY": f"default-src 'none'; {allowed}",
        "TITLE": html.escape(printable(scene.title)),
        "STYLE": style,
        "SCENE": _json(known),
        "MARKS": _json(list(scene.marks)),
        "SPLATS": "\n".join(parts),
        "SCRIPT": script,
    }
    text = room.joinpath("page.html").read_text("utf-8")
    return re.sub("@([A-Z]+)@", lambda found: words[found[1]], text)


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _levels(palette: Palette) -> str:
    """256 colours as hexadecimal digits."""
    return np.rint(255 * palette.to_color(np.linspace(0, 1, 256))).astype(np.uint8).tobytes().hex()


def _json(content: Any) -> str:
    """JSON that no HTML ends: a name of a stranger may hold </script>."""
    text = json.dumps(content, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c")
