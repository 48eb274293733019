"""DJI's radiometric JPEGs (R-JPEG): temperatures where the file holds them, else who converts its counts.

The sensor's 16-bit values lie in the segments APP3 (XT S: APP4), the state of the camera in APP4. Bytes 4 to 7 there
name the part of DJI's SDK that reads the file: "iirp" files hold temperatures, value / 64 = kelvin, whose two low bits
are always 0 (exiftool.org, forum topic 11401). All others hold counts, which DJI's SDK alone knows how to convert.

Temperatures are those of a black body before the lens: nothing of the emissivity, distance and air that the file states
is in them. Where all of these have the temperature that is read, no correction changes it, and there the reimplemented
SDK (dji-thermal-cli 1.4.0) gives the same within 0.04 °C, on files of H20N, H30T, M2EA, M30T, M3T and M4T (2026-11-28).
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from thermosplat.datasets.images.image_bytes import image_header, read_regular_file
from thermosplat.datasets.images.jpeg_segments import APP0, joined
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import Exif
from thermosplat.prepare.importing.embedded_picture import shows_the_same
from thermosplat.prepare.importing.exif import parse_exif
from thermosplat.thermal.planck_counts import ZERO_CELSIUS
from thermosplat.thermal.thermal_parameters import ThermalParameters

_APP3, _APP4 = APP0 + 3, APP0 + 4
_STEPS_PER_KELVIN = 64
_LEAST_VALUES = 120 * 90
"""Fewer are no image of a sensor."""
_END_OF_IMAGE = b"\xff\xd9"
"""The XT S does not write it, and without it OpenCV decodes nothing."""
_MAGIC, _DIRP, _LINEAR = b"\xff\xd2\xd1\xff", b"\xaa\x55\x12\x06", "iirp"
_SIZE_AT, _PARAMETERS_AT = 0x9D, 0x20
"""Where the state of "iirp" files has width and height (uint16), and air temperature [°C], distance [m], emissivity,
humidity and reflected temperature (float32). Files of the M2EA have these at the very beginning (ExifTool)."""
_FRAME_AT, _LEVELS_AT = 0x133, 0x142
"""Where files of H30T and M4T have a level of the frame, five times in 13 bytes, and then the lowest, mean and highest
value of a part of it."""
_BESIDE = 3.0
"""How far [°C] these may lie outside the values of the file, which may be of the next frame."""
_POSSIBLE = (-100.0, 700.0)
"""Temperatures [°C] of scenes; 16 bits end at 751 °C."""
_AGAIN = (
    "Copy the file from the card again; programs that edit pictures drop what they do not know. Or leave it out: "
    "--skip-unreadable"
)


@dataclass(frozen=True, eq=False)
class DjiFile:
    """What an R-JPEG holds.

    Args:
        layout: The part of DJI's SDK that reads it: "iirp", "hirp", "girp", "dirp", or "" for one that is not known.
        stored: [H, W] uint16, as the sensor's values are stored.
        state: The camera's state, as bytes.
        content: The whole file.
    """

    path: Path
    exif: Exif
    layout: str
    stored: NDArray[np.uint16]
    parameters: ThermalParameters
    state: bytes = field(repr=False)
    content: bytes = field(repr=False)

    @property
    def model(self) -> str:
        """The camera's name, with its maker."""
        return f"DJI {self.exif.model or 'camera of an unknown model'}"

    @property
    def holds_temperatures(self) -> bool:
        """The stored values are temperatures, and not counts."""
        return self.layout == _LINEAR and not (self.stored & 3).any()

    def celsius(self) -> NDArray[np.float32]:
        """The temperatures that the file holds [°C], [H, W].

        Raises:
            UserError: They contradict what else the file says.
        """
        celsius = (self.stored / np.float32(_STEPS_PER_KELVIN) - np.float32(ZERO_CELSIUS)).astype(np.float32)
        low, high = (float(end) for end in np.percentile(celsius, [1, 99]))
        if not (_POSSIBLE[0] < low and high < _POSSIBLE[1]):
            raise _contradicted(self.path, f"they lie between {low:.0f} and {high:.0f} °C")
        lowest, highest = float(celsius.min()), float(celsius.max())
        for stated in self._stated_levels():
            if not lowest - _BESIDE <= stated <= highest + _BESIDE:
                span = f"{lowest:.1f} to {highest:.1f} °C"
                raise _contradicted(
                    self.path, f"they are {span}, and the file states {stated:.1f} °C of a part of them"
                )
        self.check_picture(celsius)
        return celsius

    def check_picture(self, celsius: NDArray[np.float32]) -> None:
        """Hold temperatures [H, W] of this file, wherever they come from, against the picture in it.

        Raises:
            UserError: They show something else.
        """
        picture = self.picture()
        if picture is None:
            raise _contradicted(self.path, "the picture in it cannot be decoded")
        if not shows_the_same(celsius, picture, self.exif.digital_zoom or 1.0):
            raise _contradicted(self.path, "the picture in it shows something else")

    def picture(self) -> NDArray[np.uint8] | None:
        """The picture that is seen, [h, w, 3]; None where it cannot be decoded."""
        whole = np.frombuffer(self.content + _END_OF_IMAGE, np.uint8)
        decoded = cv2.imdecode(whole, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return None if decoded is None else np.ascontiguousarray(decoded[..., ::-1])

    def _stated_levels(self) -> list[float]:
        """Lowest, mean and highest temperature [°C] of a part of the frame, where the camera's state has them."""
        same = {self.state[at : at + 2] for at in range(_FRAME_AT, _FRAME_AT + 15, 3)}
        if len(same) != 1 or same == {b"\0\0"} or len(self.state) < _LEVELS_AT + 6:
            return []
        levels = struct.unpack_from("<3H", self.state, _LEVELS_AT)
        return [level / _STEPS_PER_KELVIN - ZERO_CELSIUS for level in levels]


def is_dji_thermal(content: bytes, make: str | None) -> bool:
    """Whether a JPEG is DJI's with the values of a thermal sensor inside, whole or not.

    Args:
        make: Its maker by EXIF data, which a program may have dropped.
    """
    states_it = joined(content, _APP4).startswith((_MAGIC, _DIRP))
    if not (states_it or (make is not None and make.upper().startswith("DJI"))):
        return False
    return any(len(joined(content, marker)) >= 2 * _LEAST_VALUES for marker in (_APP3, _APP4))


def read_dji(path: Path) -> DjiFile:
    """Read an R-JPEG.

    Raises:
        UserError: It cannot be read, or its segments are not those of one image.
    """
    content = read_regular_file(path)
    values, state = joined(content, _APP3), joined(content, _APP4)
    if len(state) > len(values):  # XT S
        values, state = state, b""
    header = image_header(content)
    size = _sensor_size(len(values), state, (header.width, header.height) if header else (0, 0))
    if size is None:
        raise UserError(
            f"The radiometric data in {path} is damaged: {len(values):,} bytes are no image of the sensor.", _AGAIN
        )
    width, height = size
    stored = np.frombuffer(values, "<u2").reshape(height, width).astype(np.uint16)
    layout = _layout(state)
    return DjiFile(path, parse_exif(content), layout, stored, _parameters(layout, state), state, content)


def _sensor_size(length: int, state: bytes, picture: tuple[int, int]) -> tuple[int, int] | None:
    """Width and height of so many bytes of values: as the state says, else those of the picture or a part of it."""
    stated = struct.unpack_from("<HH", state, _SIZE_AT) if len(state) >= _SIZE_AT + 4 else (0, 0)
    candidates = [stated, *((picture[0] // part, picture[1] // part) for part in (1, 2, 3, 4))]
    sizes = [(width, height) for width, height in candidates if 2 * width * height == length >= 2 * _LEAST_VALUES]
    return sizes[0] if sizes else None


def _layout(state: bytes) -> str:
    if state.startswith(_MAGIC):
        return state[4:8].decode("ascii", "replace")
    if state.startswith(_DIRP):
        return "dirp"
    return _LINEAR if _floats(state, 0) is not None else ""


def _floats(state: bytes, at: int) -> tuple[float, ...] | None:
    """Air temperature, distance, emissivity, humidity and reflected temperature, if these can be such."""
    if len(state) < at + 20:
        return None
    air, distance, emissivity, humidity, reflected = found = struct.unpack_from("<5f", state, at)
    possible = -60 <= air <= 100 and 0 <= distance <= 2000 and 0.05 < emissivity <= 1 and 0 <= humidity <= 1
    return found if possible and -100 <= reflected <= 1000 else None


def _parameters(layout: str, state: bytes) -> ThermalParameters:
    """What the camera's state says of object and air (ExifTool, DJI.pm; "hirp" as dji-thermal-cli shows them)."""
    nothing = (None,) * 5
    values: tuple[float | None, ...] = nothing
    if layout == _LINEAR:
        values = _floats(state, _PARAMETERS_AT if state.startswith(_MAGIC) else 0) or nothing
    elif layout == "dirp" and len(state) >= 0x4C:
        distance, humidity, emissivity, reflected = struct.unpack_from("<4H", state, 0x44)
        values = None, distance, emissivity / 100, humidity / 100, reflected / 10
    elif layout == "hirp" and len(state) >= 0x60:
        emissivity, distance = struct.unpack_from("<HxxI", state, 0x58)
        values = None, distance / 8192, emissivity / 8192, None, None
    elif state[_PARAMETERS_AT : _PARAMETERS_AT + 4] == b"\xaa\x55\x38\0" and len(state) >= 0x2C:
        humidity, distance, emissivity, reflected = struct.unpack_from("<4H", state, 0x24)
        values = None, distance / 10, emissivity / 100, humidity / 100, reflected / 10
    air, distance_metres, share, moisture, mirrored = (None if one is None else round(one, 4) for one in values)
    return ThermalParameters(
        applied=False,
        emissivity=share if share and share <= 1 else None,
        reflected_celsius=mirrored,
        distance_metres=distance_metres,
        air_celsius=air,
        humidity=moisture if moisture is None or moisture <= 1 else None,
    )


def _contradicted(path: Path, why: str) -> UserError:
    return UserError(f"The temperatures in {path} cannot be right: {why}.", _AGAIN)
