"""Files of images with any number of channels: NumPy arrays, TIFFs of several pages, ENVI cubes with their header."""

import math
import re
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from thermosplat.errors import UserError
from thermosplat.regular_files import files_below, read_regular

STACK_SUFFIXES = frozenset({".npy", ".tif", ".tiff", ".hdr"})
_ENVI_DATA = ("", ".img", ".dat", ".raw", ".bin", ".bil", ".bip", ".bsq", ".cube")
"""Endings of the data beside NAME.hdr."""
_ENVI_TYPES = {"1": "u1", "2": "i2", "3": "i4", "4": "f4", "5": "f8", "12": "u2", "13": "u4", "14": "i8", "15": "u8"}
_ENVI_ORDERS = {"bsq": (1, 2, 0), "bil": (0, 2, 1), "bip": (0, 1, 2)}
"""By interleave, the axes of the file that are lines, samples and bands."""
_DAMAGE = (
    *(OSError, ValueError, EOFError, MemoryError, LookupError, TypeError, SyntaxError, RuntimeError, OverflowError),
    *(AttributeError, struct.error, zlib.error),
)
"""What NumPy and tifffile raise for files that are damaged, or none of theirs."""
_LARGEST = 1 << 32
"""Most bytes of a file."""


def list_stacks(folder: Path) -> list[Path]:
    """Files of stacks below a folder, sorted; of an ENVI cube its header."""
    return [path for path in files_below(folder) if path.suffix.lower() in STACK_SUFFIXES and path.name[0] != "."]


def read_stack(path: Path, channels: int) -> NDArray[np.float32]:
    """The channels of a file, [H, W, channels].

    Args:
        channels: How many it has to have; that says which of its axes they are.

    Raises:
        UserError: It is damaged, has another number of channels, or values that are no numbers.
    """
    wanted = (
        f"Expected is a stack of {channels} channels: .npy, a TIFF of several pages, or an ENVI header beside data."
    )
    try:
        if path.stat().st_size > _LARGEST:
            raise UserError(f"{path} is larger than {_LARGEST:,} bytes.", wanted)
        array = np.squeeze(_READERS.get(path.suffix.lower(), _tiff)(path))
    except UserError:
        raise
    except _DAMAGE as error:
        raise UserError(f"{path} cannot be read: it is damaged, or of another kind.", wanted) from error
    if channels == 1 and array.ndim == 2:
        array = array[..., None]
    if array.dtype.kind not in "biuf" or array.ndim != 3 or channels not in (array.shape[2], array.shape[0]):
        found = f"{array.dtype} of shape {list(array.shape)}"
        raise UserError(f"{path} holds {found}, and channels says {channels}.", wanted)
    if array.shape[2] != channels:
        array = np.moveaxis(array, 0, -1)
    stack = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(stack).all():
        raise UserError(f"{path} has values that are no finite numbers.", "Fill them, or mask those pixels.")
    return stack


def _tiff(path: Path) -> NDArray[Any]:
    return tifffile.imread(BytesIO(read_regular(path)))


def _envi(path: Path) -> NDArray[Any]:
    text = read_regular(path).decode("latin-1")
    if not text.startswith("ENVI"):
        raise ValueError("no ENVI header")
    fields = {key.strip().lower(): value.strip() for key, value in re.findall(r"^([^=;\n]+)=([^{\n]*)$", text, re.M)}
    order = _ENVI_ORDERS[fields["interleave"].lower()]
    sizes = {0: int(fields["lines"]), 1: int(fields["samples"]), 2: int(fields["bands"])}
    shape = [0, 0, 0]
    for meaning, axis in enumerate(order):
        shape[axis] = sizes[meaning]
    kind = np.dtype(("<", ">")[int(fields.get("byte order", "0"))] + _ENVI_TYPES[fields["data type"]])
    names = [path.with_suffix(ending) for ending in _ENVI_DATA]
    data = next((name for name in names if name != path and name.is_file()), None)
    if data is None:
        raise UserError(f"{path} has no data beside it.", f"Expected is {names[1]}, or another usual ending.")
    start, count = int(fields.get("header offset", "0")), math.prod(shape)
    content = read_regular(data)
    if min(shape) < 1 or start < 0 or len(content) < start + count * kind.itemsize:
        raise UserError(f"{data} has {len(content):,} bytes, fewer than its header {path.name} states.", "Restore it.")
    return np.frombuffer(content, kind, count, start).reshape(shape).transpose(order)


_READERS = {".npy": lambda path: np.load(BytesIO(read_regular(path)), allow_pickle=False), ".hdr": _envi}
