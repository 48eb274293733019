"""Where a drone was and where its camera looked: what DJI and others write as XMP (ExifTool, DJI.pm).

XMP is XML; only attributes and elements with a plain text are looked at, by their names without the prefix. Nothing in
it is resolved or loaded.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace

from thermosplat.datasets.images.jpeg_segments import APP0, segments
from thermosplat.prepare.capture_folder import Exif

_MARK = b"http://ns.adobe.com/xap/1.0/\0"
_PREFIXES = r"(?:drone-[\w-]{1,30}|DJI|FLIR|Camera)"
_FIELD = re.compile(rf'\b{_PREFIXES}:(\w{{1,60}})(?:\s{{0,9}}=\s{{0,9}}"([^"<]{{0,99}})"|>([^<]{{1,99}})<)')
_NO_FIX = ("invalid", "none")
"""What GpsStatus says where the receiver had no position."""


def xmp_fields(packet: bytes) -> dict[str, str]:
    """The drone's fields of an XMP packet by name, such as GpsLatitude; the first of each name."""
    found: dict[str, str] = {}
    for name, attribute, element in _FIELD.findall(packet.decode("utf-8", "replace")):
        found.setdefault(name, (attribute or element).strip())
    return found


def xmp_packet(jpeg: bytes) -> bytes:
    """The XMP packet of a JPEG; empty where there is none."""
    bodies = (body for marker, body in segments(jpeg) if marker == APP0 + 1 and body.startswith(_MARK))
    return b"".join(body[len(_MARK) :] for body in bodies)


def with_flight_data(exif: Exif, packet: bytes) -> Exif:
    """What EXIF data says of an exposure, with what an XMP packet says of the flight.

    Positions in XMP are the same as those in EXIF data, with more digits. Zero latitude and longitude are no position.

    Args:
        packet: The file's XMP packet; empty for none.
    """
    fields = xmp_fields(packet)
    changes: dict[str, float | int | None] = {
        name: value
        for name, key, least, most in (
            ("relative_altitude", "RelativeAltitude", -1e4, 1e5),
            ("gimbal_yaw", "GimbalYawDegree", -360, 360),
            ("gimbal_pitch", "GimbalPitchDegree", -360, 360),
            ("gimbal_roll", "GimbalRollDegree", -360, 360),
            ("altitude_std", "RtkStdHgt", 0, 1e4),
        )
        if (value := _number(fields, key, least, most)) is not None
    }
    if (flag := _number(fields, "RtkFlag", 0, 99)) is not None:
        changes["rtk_flag"] = int(flag)
    spreads = [_number(fields, key, 0, 1e4) for key in ("RtkStdLon", "RtkStdLat")]
    if spreads[0] is not None and spreads[1] is not None:
        changes["position_std"] = max(spreads[0], spreads[1])
    latitude = _first(fields, ("GpsLatitude", "Latitude"), 90)
    longitude = _first(fields, ("GpsLongitude", "GpsLongtitude", "Longitude"), 180)  # the misspelling is DJI's
    if latitude is not None and longitude is not None:
        changes |= {"latitude": latitude, "longitude": longitude}
        if (altitude := _number(fields, "AbsoluteAltitude", -1e4, 1e5)) is not None:
            changes["altitude"] = altitude
    found = replace(exif, **changes)  # type: ignore[arg-type]
    if (found.latitude, found.longitude) == (0, 0) or fields.get("GpsStatus", "").lower() in _NO_FIX:
        return replace(found, latitude=None, longitude=None, altitude=None)
    return found


def _first(fields: Mapping[str, str], keys: tuple[str, ...], most: float) -> float | None:
    return next((value for key in keys if (value := _number(fields, key, -most, most)) is not None), None)


def _number(fields: Mapping[str, str], key: str, least: float, most: float) -> float | None:
    try:
        value = float(fields[key])
    except (KeyError, ValueError):
        return None
    return value if math.isfinite(value) and least <= value <= most else None
