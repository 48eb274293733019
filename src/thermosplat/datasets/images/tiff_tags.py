"""What a TIFF's own tags say of its pixels: decoders are held to it.

Layout: TIFF 6.0 and BigTIFF; NoData is GDAL's tag.
"""

import struct
from dataclasses import dataclass
from typing import Any

from thermosplat.datasets.images.file_content import Content, unpacked

_TYPES = {1: "B", 2: "c", 3: "H", 4: "I", 16: "Q"}
_MOST_TAGS = 4096
_MOST_VALUES = 64
"""Of a tag that are looked at; no image that is read has more samples, and no number more characters."""
_WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _ORIENTATION = 256, 257, 258, 259, 262, 274
_SAMPLES, _PLANAR, _TILE_WIDTH, _TILE_HEIGHT, _EXTRA, _FORMAT, _NODATA = 277, 284, 322, 323, 338, 339, 42113
_KNOWN = frozenset(
    {
        *(_WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _ORIENTATION),
        *(_SAMPLES, _PLANAR, _TILE_WIDTH, _TILE_HEIGHT, _EXTRA, _FORMAT, _NODATA),
    }
)
UNSIGNED, SIGNED, FLOATING = 1, 2, 3
"""Sample formats that are read."""
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE, YCBCR = 0, 1, 2, 3, 6
"""Photometric interpretations that are read."""
ASSOCIATED, UNASSOCIATED = 1, 2
"""Kinds of alpha among the extra samples; colours were multiplied by the first."""


@dataclass(frozen=True)
class TiffTags:
    """The tags of a file's first image.

    Args:
        width: [px].
        height: [px].
        bits: Of a sample; 0 where samples differ in it.
        samples: Of a pixel.
        sample_format: ``UNSIGNED``, ``SIGNED``, ``FLOATING`` or another; 0 where samples differ in it.
        photometric: What the samples mean; None where no tag says so.
        planar: Samples lie in planes of their own.
        compression: 1 for none.
        turned_at: Where the orientation's value lies in the file [bytes], and its ``struct`` layout; None where there
            is none, or it says that the image is upright.
        extra: Kinds of the samples beyond colours.
        tile_width: [px]; 0 for an image in strips.
        tile_height: [px].
        nodata: The value of pixels without one.
    """

    width: int
    height: int
    bits: int
    samples: int
    sample_format: int
    photometric: int | None
    planar: bool
    compression: int
    turned_at: tuple[int, str] | None
    extra: tuple[int, ...]
    tile_width: int
    tile_height: int
    nodata: float | None

    @property
    def channels(self) -> int:
        """Of the image without its extra samples: 1 for one value per pixel, else 3.

        Three samples that no tag calls colours, or these and alpha, are colours: GDAL writes 16-bit photographs so.
        """
        if self.photometric not in (WHITE_IS_ZERO, BLACK_IS_ZERO, None):
            return 3
        unnamed = self.samples - len([kind for kind in self.extra if kind in (ASSOCIATED, UNASSOCIATED)])
        return 3 if unnamed == 3 and self.sample_format == UNSIGNED and self.bits <= 16 else 1

    @property
    def alpha(self) -> tuple[int, int] | None:
        """The sample that is alpha and its kind; None where there is none."""
        first = self.samples - len(self.extra)
        alphas = [(first + place, kind) for place, kind in enumerate(self.extra) if kind in (ASSOCIATED, UNASSOCIATED)]
        return alphas[0] if alphas and alphas[0][0] >= self.channels else None


def read_tiff_tags(content: Content) -> TiffTags | None:
    """The tags of a TIFF; None where it states no size.

    Raises:
        struct.error: The file ends before.
    """
    tags, places = _tags(content)
    if _WIDTH not in tags or _HEIGHT not in tags:
        return None

    def first(tag: int, usual: int) -> int:
        value = tags.get(tag, (usual,))[0]
        return value if isinstance(value, int) else 0

    bits, formats = tags.get(_BITS, (1,)), tags.get(_FORMAT, (UNSIGNED,))
    return TiffTags(
        first(_WIDTH, 0),
        first(_HEIGHT, 0),
        first(_BITS, 1) if len(set(bits)) == 1 else 0,
        first(_SAMPLES, 1),
        first(_FORMAT, UNSIGNED) if len(set(formats)) == 1 else 0,
        first(_PHOTOMETRIC, 0) if _PHOTOMETRIC in tags else None,
        first(_PLANAR, 1) == 2 and first(_SAMPLES, 1) > 1,
        first(_COMPRESSION, 1),
        places.get(_ORIENTATION) if first(_ORIENTATION, 1) != 1 else None,
        tuple(kind for kind in tags.get(_EXTRA, ()) if isinstance(kind, int)),
        first(_TILE_WIDTH, 0),
        first(_TILE_HEIGHT, 0),
        _number(tags.get(_NODATA, ())),
    )


def upright(content: bytes, tags: TiffTags) -> bytes:
    """The file with its orientation tag set to 1, so that no decoder turns what is stored."""
    if tags.turned_at is None:
        return content
    place, layout = tags.turned_at
    changed = bytearray(content)
    struct.pack_into(layout, changed, place, 1)
    return bytes(changed)


def _tags(content: Content) -> tuple[dict[int, tuple[Any, ...]], dict[int, tuple[int, str]]]:
    """The first values of each tag that is known, of the first image; and where they lie, with their layout.

    Values of a type that is not known count as one 0.
    """
    order = "<" if content[:2] == b"II" else ">"
    (version,) = unpacked(order + "H", content, 2)
    number, count, size = ("I", "H", 12) if version == 42 else ("Q", "Q", 20)
    room = struct.calcsize(order + number)
    (at,) = unpacked(order + number, content, room)
    (entries,) = unpacked(order + count, content, at)
    at += struct.calcsize(order + count)
    tags: dict[int, tuple[Any, ...]] = {}
    places: dict[int, tuple[int, str]] = {}
    for entry in range(at, at + min(entries, _MOST_TAGS) * size, size):
        tag, kind = unpacked(order + "HH", content, entry)
        (values,) = unpacked(order + number, content, entry + 4)
        letter = _TYPES.get(kind)
        if tag not in _KNOWN:
            continue
        if letter is None or values == 0:
            tags[tag] = (0,)
            continue
        place = entry + 4 + room
        if values * struct.calcsize(letter) > room:  # the values lie elsewhere
            (place,) = unpacked(order + number, content, place)
        places[tag] = place, order + letter
        tags[tag] = unpacked(f"{order}{min(values, _MOST_VALUES)}{letter}", content, place)
    return tags, places


def _number(characters: tuple[Any, ...]) -> float | None:
    try:
        return float(b"".join(characters).split(b"\0")[0])
    except (TypeError, ValueError):
        return None
