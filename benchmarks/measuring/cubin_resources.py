"""Registers, local and shared memory of the kernels in a cubin, without NVIDIA's tools."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

_VALUE_OF_SIZE, _REGISTERS, _FRAME = 0x04, 0x2F, 0x11  # EIFMT_SVAL, EIATTR_REGCOUNT, EIATTR_FRAME_SIZE
_SYMBOL = "<IBBHQQ"


class Section(NamedTuple):
    """A section of an ELF file."""

    name: str
    start: int
    size: int


@dataclass(frozen=True)
class Resources:
    """What one kernel takes."""

    registers: int
    """Of a thread."""
    shared: int
    """Static shared memory of a block [bytes]."""
    local: int
    """Local memory of a thread, which is where registers are spilt to [bytes]."""


def cubin_resources(path: Path) -> dict[str, Resources]:
    """Resources by the kernel's symbol.

    Raises:
        ValueError: The file is no 64-bit ELF file.
    """
    data = path.read_bytes()
    if data[:5] != b"\x7fELF\x02":
        raise ValueError(f"{path} is no cubin.")
    sections = _sections(data)
    names = _symbols(data, sections)
    (info,) = [section for section in sections if section.name == ".nv.info"]
    registers: dict[str, int] = {}
    frames: dict[str, int] = {}
    at, end = info.start, info.start + info.size
    while at < end:
        form, attribute, size = struct.unpack_from("<BBH", data, at)
        at += 4
        if form == _VALUE_OF_SIZE:
            if attribute in (_REGISTERS, _FRAME):
                symbol, value = struct.unpack_from("<II", data, at)
                (registers if attribute == _REGISTERS else frames)[names[symbol]] = value
            at += size
    shared = {s.name.removeprefix(".nv.shared."): s.size for s in sections if s.name.startswith(".nv.shared.")}
    return {name: Resources(count, shared.get(name, 0), frames.get(name, 0)) for name, count in registers.items()}


def _sections(data: bytes) -> list[Section]:
    (table,) = struct.unpack_from("<Q", data, 0x28)
    size, count, names = struct.unpack_from("<HHH", data, 0x3A)
    headers = [struct.unpack_from("<IIQQQQ", data, table + k * size) for k in range(count)]
    start = headers[names][4]
    return [Section(_text(data, start + name), place, length) for name, _, _, _, place, length in headers]


def _symbols(data: bytes, sections: list[Section]) -> list[str]:
    table = next(section for section in sections if section.name == ".symtab")
    texts = next(section for section in sections if section.name == ".strtab")
    places = range(table.start, table.start + table.size, struct.calcsize(_SYMBOL))
    return [_text(data, texts.start + struct.unpack_from(_SYMBOL, data, place)[0]) for place in places]


def _text(data: bytes, start: int) -> str:
    return data[start : data.index(b"\0", start)].decode()
