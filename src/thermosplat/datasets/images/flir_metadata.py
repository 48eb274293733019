"""The FFF file that FLIR cameras store in their JPEG files, and the palette in it.

APP1 segments marked "FLIR" hold the pieces of one FFF file; its record of type 0x22 is the palette: the number of
entries in byte 0 and from byte 0x70 on their Y, Cr, Cb in limited-range BT.601 (ExifTool documents the format; decoded
like this, the palettes of RGBT-Scenes lie about 2 of 255 levels from the images' pixels).
"""

import struct
from pathlib import Path

import numpy as np

from thermosplat.datasets.images.jpeg_segments import APP0, segments
from thermosplat.regular_files import read_regular
from thermosplat.thermal.radiometry import Palette

_MARK = b"FLIR\0"
_PALETTE_RECORD = 0x22
_ENTRIES_AT = 0x70


def read_flir_palette(path: Path) -> Palette | None:
    """The palette stored in a JPEG file, or None where there is none (any other file included)."""
    try:
        record = fff_record(fff_file(read_regular(path)), _PALETTE_RECORD)
        count = record[0]
        ycc = np.frombuffer(record, np.uint8, 3 * count, _ENTRIES_AT).reshape(count, 3).astype(np.float64)
    except (OSError, struct.error, ValueError, IndexError, LookupError):
        return None
    if count < 2:
        return None
    y, cr, cb = (ycc[:, 0] - 16) * (255 / 219), (ycc[:, 1] - 128) * (255 / 224), (ycc[:, 2] - 128) * (255 / 224)
    rgb = np.stack([y + 1.402 * cr, y - 0.344136 * cb - 0.714136 * cr, y + 1.772 * cb], -1)
    return Palette((np.clip(rgb, 0, 255) / 255).astype(np.float32))


def fff_file(jpeg: bytes) -> bytes:
    """The pieces in the file's APP1 segments, joined; empty where there are none."""
    bodies = (body for marker, body in segments(jpeg) if marker == APP0 + 1 and body.startswith(_MARK))
    pieces = {body[6]: body[8:] for body in bodies}
    return b"".join(pieces[number] for number in sorted(pieces))


def fff_record(fff: bytes, kind: int) -> bytes:
    """The first record of a kind in an FFF file, either byte order.

    Raises:
        LookupError: There is none, or it is no FFF file.
    """
    if not fff.startswith(b"FFF\0"):
        raise LookupError("not an FFF file")
    order = ">" if 100 <= struct.unpack_from(">I", fff, 0x14)[0] < 200 else "<"
    directory, count = struct.unpack_from(order + "II", fff, 0x18)
    for number in range(min(count, 1000)):
        found, _, _, _, offset, length = struct.unpack_from(order + "HHIIII", fff, directory + 32 * number)
        if found == kind and length > 0:
            return fff[offset : offset + length]
    raise LookupError("no such record")
