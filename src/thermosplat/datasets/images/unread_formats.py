"""Pictures in formats that are not read: named, and how to convert them."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from thermosplat.errors import UserError
from thermosplat.regular_files import files_below

_BY_SUFFIX = {
    **{".heic": "HEIC", ".heif": "HEIF", ".hif": "HEIF", ".avif": "AVIF", ".gif": "GIF", ".jxl": "JPEG XL"},
    **{".jp2": "JPEG 2000", ".j2k": "JPEG 2000", ".exr": "OpenEXR", ".psd": "Photoshop", ".svg": "SVG"},
    **{".tga": "TGA", ".ppm": "PNM", ".pgm": "PNM", ".pnm": "PNM"},
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"), "raw"),
}
"""Names of formats by the endings of their files."""
_BY_BEGIN = {
    **{b"GIF8": ".gif", b"8BPS": ".psd", b"v/1\x01": ".exr", b"\xff\x0a": ".jxl", b"\0\0\0\x0cJXL ": ".jxl"},
    **{b"\0\0\0\x0cjP  ": ".jp2", b"P5\n": ".pgm", b"P6\n": ".ppm"},
}
_BRANDS = {b"avif": ".avif", b"avis": ".avif", **dict.fromkeys((b"heic", b"heix", b"hevc", b"mif1", b"msf1"), ".heic")}
"""Formats by what stands behind "ftyp" in a file."""


def unread_note(folder: Path) -> str | None:
    """What pictures of a folder are not read, and what to do; None where there are none.

    Args:
        folder: Where to look, at any depth.
    """
    found = [path for path in files_below(folder) if path.suffix.lower() in _BY_SUFFIX]
    return _note(found, folder) if found else None


def unread_content(path: Path, content: bytes) -> UserError | None:
    """The error for a file that is a picture in a format that is not read, whatever its name; None for another file."""
    suffix = _BRANDS.get(content[8:12]) if content[4:8] == b"ftyp" else None
    suffix = suffix or next((suffix for begin, suffix in _BY_BEGIN.items() if content.startswith(begin)), None)
    if suffix is None:
        return None
    return UserError(f"{path} is a picture of the format {_BY_SUFFIX[suffix]}, which is not read.", _hint(path))


def _note(paths: Sequence[Path], folder: Path) -> str:
    formats = " and ".join(dict.fromkeys(_BY_SUFFIX[path.suffix.lower()] for path in paths))
    count = "1 picture" if len(paths) == 1 else f"{len(paths)} pictures"
    are = "is" if len(paths) == 1 else "are"
    return (
        f"{count} of {folder} {are} {formats}, which is not read (first: {paths[0].relative_to(folder)}). "
        f"{_hint(paths[0])}"
    )


def _hint(path: Path) -> str:
    if _BY_SUFFIX.get(path.suffix.lower()) == "raw":
        return "Develop them into JPEG or TIFF files with a raw converter."
    pattern = f"{shlex.quote(str(path.parent))}/*{path.suffix}"
    return f"Convert them to JPEG or PNG, such as: magick mogrify -format jpg {pattern}"
