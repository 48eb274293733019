"""When, where and with which camera a picture was taken: EXIF data of JPEG and TIFF files, and XMP of drones.

Format: EXIF 2.32 (CIPA DC-008) on TIFF 6.0. OpenCV has no reader of it, and Pillow is not a dependency. Damaged data
counts as absent, because pictures are of use without it.
"""

import math
import re
import struct
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from thermosplat.datasets.images.jpeg_segments import APP0, segments
from thermosplat.prepare.capture_folder import Exif
from thermosplat.prepare.importing.flight_data import with_flight_data, xmp_packet
from thermosplat.regular_files import open_regular

_HEAD = 1 << 18
"""Bytes at a file's beginning in which a JPEG has its EXIF segment, which is at most 64 KiB long."""
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
"""Bytes per value of each TIFF type."""
_FORMATS = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d"}
_MOST_VALUES = 1 << 16
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_MAKE, _MODEL, _ORIENTATION, _DATE = 0x010F, 0x0110, 0x0112, 0x0132
_DATE_ORIGINAL, _ZONE, _ZONE_ORIGINAL = 0x9003, 0x9010, 0x9011
_SUBSECONDS, _SUBSECONDS_ORIGINAL = 0x9290, 0x9291
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_ISO, _DIGITAL_ZOOM, _XMP = 0x8827, 0xA404, 0x02BC
_DATE_FORMAT = "%Y:%m:%d %H:%M:%S"


def read_exif(path: Path) -> Exif:
    """The EXIF data of a file; all None where there is none."""
    try:
        with open_regular(path) as file:
            content = file.read(_HEAD)
            if content[:4] in (b"II*\0", b"MM\0*"):
                content += file.read()  # a TIFF has its tables anywhere
    except OSError:
        return Exif()
    return parse_exif(content)


def parse_exif(content: bytes) -> Exif:
    """The EXIF data in a JPEG or TIFF file's bytes, and what a drone wrote beside it."""
    is_tiff = content[:4] in (b"II*\0", b"MM\0*")
    tiff = content if is_tiff else _exif_segment(content)
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    main = _table(tiff, order, _number(tiff, order, 4)) if order is not None and len(tiff) >= 8 else {}
    inner = main | _table(tiff, order or "<", main.get(_EXIF_IFD))
    gps = _table(tiff, order or "<", main.get(_GPS_IFD))
    found = Exif(
        time=_time(inner),
        latitude=_degrees(gps.get(2), gps.get(1), "S", 90),
        longitude=_degrees(gps.get(4), gps.get(3), "W", 180),
        altitude=_altitude(gps),
        focal_length_mm=_positive(inner.get(_FOCAL_LENGTH)),
        focal_length_35mm=_positive(inner.get(_FOCAL_LENGTH_35MM)),
        make=_text(main.get(_MAKE)),
        model=_text(main.get(_MODEL)),
        orientation=value if (value := main.get(_ORIENTATION)) in range(1, 9) else None,
        iso=_positive(inner.get(_ISO)),
        digital_zoom=zoom if (zoom := _positive(inner.get(_DIGITAL_ZOOM)) or 0) > 1 else None,
    )
    return with_flight_data(found, _bytes(main.get(_XMP)) if is_tiff else xmp_packet(content))


def _exif_segment(content: bytes) -> bytes:
    """The TIFF inside a JPEG's EXIF segment; empty where there is none."""
    bodies = (body for marker, body in segments(content) if marker == APP0 + 1)
    return next((body[6:] for body in bodies if body.startswith(b"Exif\0\0")), b"")


def _number(tiff: bytes, order: str, at: int) -> int:
    return struct.unpack_from(order + "I", tiff, at)[0]


def _table(tiff: bytes, order: str, at: Any) -> dict[int, Any]:
    """The values of one table of tags; numbers alone or in a tuple, texts as bytes."""
    values: dict[int, Any] = {}
    try:
        (count,) = struct.unpack_from(order + "H", tiff, at)
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            tag, kind, length = struct.unpack_from(order + "HHI", tiff, entry)
            if kind in _SIZES and 0 < length <= _MOST_VALUES:
                size = _SIZES[kind] * length
                place = entry + 8 if size <= 4 else _number(tiff, order, entry + 8)
                if place + size <= len(tiff):
                    values.setdefault(tag, _values(tiff[place : place + size], order, kind, length))
    except (struct.error, TypeError):
        pass  # cut off: what came before holds
    return values


def _values(data: bytes, order: str, kind: int, length: int) -> Any:
    if kind in (2, 7):
        return data
    if kind in (5, 10):
        parts = struct.unpack(f"{order}{2 * length}{'I' if kind == 5 else 'i'}", data)
        values = tuple(top / bottom if bottom else math.nan for top, bottom in zip(parts[::2], parts[1::2]))
    else:
        values = struct.unpack(f"{order}{length}{_FORMATS[kind]}", data)
    return values[0] if length == 1 else values


def _text(value: Any) -> str | None:
    if not isinstance(value, bytes):
        return None
    return value.split(b"\0")[0].decode("utf-8", "replace").strip() or None


def _bytes(value: Any) -> bytes:
    """A value of bytes, which tables hold as such or as numbers."""
    sound = isinstance(value, bytes | tuple) and all(isinstance(one, int) and 0 <= one < 256 for one in value)
    return bytes(value) if sound else b""


def _positive(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) and value > 0 else None


def _time(values: Mapping[int, Any]) -> str | None:
    for date, subseconds, zone in (
        (_DATE_ORIGINAL, _SUBSECONDS_ORIGINAL, _ZONE_ORIGINAL),
        (_DATE, _SUBSECONDS, _ZONE),
    ):
        try:
            moment = datetime.strptime(_text(values.get(date)) or "", _DATE_FORMAT)
        except ValueError:
            continue
        moment += timedelta(seconds=_fraction(_text(values.get(subseconds))))
        offset = _text(values.get(zone)) or ""
        stated = offset if re.fullmatch(r"[+-]\d\d:\d\d", offset) else ""
        return moment.isoformat(timespec="milliseconds" if moment.microsecond else "seconds") + stated
    return None


def _fraction(text: str | None) -> float:
    """A part of a second: "67" is 0.67; Workswell writes "782/1000"."""
    if text and re.fullmatch(r"\d+", text):
        return float(f"0.{text}")
    if text and (parts := re.fullmatch(r"(\d+)/(\d*[1-9]\d*)", text)):
        return min(int(parts[1]) / int(parts[2]), 0.999999)
    return 0.0


def _degrees(value: Any, side: Any, negative: str, most: float) -> float | None:
    if not isinstance(value, tuple) or len(value) != 3:
        return None
    degrees = value[0] + value[1] / 60 + value[2] / 3600
    if not (math.isfinite(degrees) and 0 <= degrees <= most):
        return None
    return round(-degrees if _text(side) == negative else degrees, 8)


def _altitude(gps: Mapping[int, Any]) -> float | None:
    value = gps.get(6)
    if not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return -float(value) if gps.get(5) in (1, b"\x01") else float(value)
