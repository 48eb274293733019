"""The segments at the beginning of a JPEG file, where cameras store what is no picture (ITU T.81, section B.1.1.4)."""

from collections.abc import Iterator

APP0 = 0xE0
"""Marker of the first kind of application data; APP1 is one more, and so on."""
_SCAN, _END, _FILL = 0xDA, 0xD9, 0xFF


def segments(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Marker and body of each segment before the picture; nothing for a file that is no JPEG."""
    for at, length in _places(content):
        yield content[at + 1], content[at + 4 : at + 2 + length]


def is_whole_jpeg(content: bytes) -> bool:
    """Whether a JPEG's image has an end; decoders show one that was cut off as half grey, without an error."""
    picture = max((at + 2 + length for at, length in _places(content)), default=2)
    return content.find(b"\xff\xd9", picture) >= 0


def _places(content: bytes) -> Iterator[tuple[int, int]]:
    """Where each segment before the picture begins, and its length without the marker."""
    at = 2 if content.startswith(b"\xff\xd8") else len(content)
    while at + 4 <= len(content) and content[at] == 0xFF and content[at + 1] not in (_SCAN, _END):
        if content[at + 1] == _FILL:
            at += 1
            continue
        length = max(int.from_bytes(content[at + 2 : at + 4], "big"), 2)
        yield at, length
        at += 2 + length


def joined(content: bytes, marker: int) -> bytes:
    """The bodies of all segments with a marker, one after the other."""
    return b"".join(body for found, body in segments(content) if found == marker)
