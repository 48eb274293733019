"""Whether the records of COLMAP's binary files fit into them: pycolmap allocates or skips what a damaged length says.

Files are little-endian. Each begins with its number of records (uint64). A record has a fixed part, and lists whose
lengths stand before them: points of an image, images of a point's track, sensors of a rig, images of a rig frame.
Source of the layouts: COLMAP's documentation of its output format, and its reconstruction_io.
"""

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

import cv2  # noqa: F401  before pycolmap, see lens.py
import pycolmap

Content = mmap.mmap | bytes
Walk = Callable[[Content, int], int]
"""From where a record begins to where it ends [bytes]."""

_UINT32, _UINT64 = struct.Struct("<I"), struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
_IMAGE_BYTES = 4 + 7 * 8 + 4  # id, pose, camera; then the name, which ends with a zero byte
_POINT2D_BYTES = 2 * 8 + 8  # x, y, id of the 3D point
_POINT3D_BYTES = 8 + 3 * 8 + 3 + 8  # id, position, colour, error; then the track
_TRACK_BYTES = 4 + 4  # image, place in its list of points
_SENSOR_BYTES = 4 + 4  # kind, id
_POSE_BYTES = 7 * 8
_FRAME_BYTES = 4 + 4 + _POSE_BYTES  # id, rig, pose; then the data
_DATA_BYTES = _SENSOR_BYTES + 8
_LONGEST_NAME = 4096
"""Bytes of a name that a file system takes (Linux: PATH_MAX); a longer one is no name."""

MODEL_NAMES = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
"""Names of COLMAP's camera models by their numbers."""


class Damage(ValueError):
    """What is wrong with a file, in words that follow its name."""


def wrong_lengths(folder: Path) -> str | None:
    """The first binary file of a model whose records do not fill it to the byte, and how; None if all do."""
    for name, walk in _WALKS.items():
        path = folder / name
        if not path.is_file():
            continue
        try:
            with path.open("rb") as file:
                if path.stat().st_size < _UINT64.size:
                    raise Damage("it is shorter than a count of records")
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
                    _walk(content, walk)
        except Damage as damage:
            return f"{name} is damaged: {damage}"
    return None


def _walk(content: Content, walk: Walk) -> None:
    (count,) = _UINT64.unpack_from(content)
    at, end = _UINT64.size, len(content)
    for number in range(count):
        try:
            at = walk(content, at)
        except struct.error:  # the fixed part reaches beyond the end
            at = end + 1
        if at > end:
            raise Damage(f"its record {number + 1:,} of {count:,} reaches beyond the end of the file ({end:,} bytes)")
    if at < end:
        raise Damage(f"{end - at:,} bytes follow its {count:,} records")


def _camera(content: Content, at: int) -> int:
    camera, model, *_ = _CAMERA.unpack_from(content, at)
    if model not in MODEL_NAMES:
        raise Damage(f"camera {camera} has the model number {model}, which COLMAP does not have")
    return at + _CAMERA.size + 8 * len(_parameters(model))


def _parameters(model: int) -> list[str]:
    return [name for name in pycolmap.Camera(model=MODEL_NAMES[model]).params_info.split(",") if name.strip()]


def _image(content: Content, at: int) -> int:
    begin = at + _IMAGE_BYTES
    end = content.find(b"\0", begin, begin + _LONGEST_NAME)
    if end < 0:
        (image,) = _UINT32.unpack_from(content, at)
        raise Damage(f"the name of image {image} does not end within {_LONGEST_NAME:,} bytes")
    (points,) = _UINT64.unpack_from(content, end + 1)
    return end + 1 + _UINT64.size + points * _POINT2D_BYTES


def _point3d(content: Content, at: int) -> int:
    (images,) = _UINT64.unpack_from(content, at + _POINT3D_BYTES)
    return at + _POINT3D_BYTES + _UINT64.size + images * _TRACK_BYTES


def _rig(content: Content, at: int) -> int:
    (sensors,) = _UINT32.unpack_from(content, at + 4)
    at += 8
    if sensors == 0:
        return at
    at += _SENSOR_BYTES  # of the sensor that the others refer to
    if (sensors - 1) * (_SENSOR_BYTES + 1) > len(content) - at:
        return len(content) + 1
    for _ in range(sensors - 1):
        (has_pose,) = struct.unpack_from("<B", content, at + _SENSOR_BYTES)
        at += _SENSOR_BYTES + 1 + (_POSE_BYTES if has_pose else 0)
    return at


def _frame(content: Content, at: int) -> int:
    (images,) = _UINT32.unpack_from(content, at + _FRAME_BYTES)
    return at + _FRAME_BYTES + 4 + images * _DATA_BYTES


_WALKS: dict[str, Walk] = {
    "cameras.bin": _camera,
    "rigs.bin": _rig,
    "frames.bin": _frame,
    "images.bin": _image,
    "points3D.bin": _point3d,
}
