"""Where the drone flies, what its receiver says, and what its files are called."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rendered_captures.files.mount import Mount, Variant
from rendered_captures.scenes.block import DEPTH, WIDTH, block
from rendered_captures.sensors.lens import Lens

Array = NDArray[np.float64]
Fix = tuple[float, float, float]
"""Latitude, longitude [degrees] and altitude [m]."""
_ALTITUDE = 34.0
_ORIGIN: Fix = (47.0512, 8.3064, 452.0)
_SECONDS = 3
"""Between two frames."""


class _Flight(NamedTuple):
    """What a date's flight has of its own."""

    day: str
    start: int
    """Time of the first frame [s since midnight]."""
    planned: int
    """Frames."""
    strips: int
    along: int
    """Frames of a strip."""
    shift: tuple[float, float] = (0, 0)
    """Of all strips, to the east and to the north [m]."""
    landed: int | None = None
    """Frames after which the flight ends before its plan does."""


_FLIGHTS = (
    _Flight("20260612", 36000, planned=104, strips=6, along=12, landed=101),
    _Flight("20260619", 36000, planned=82, strips=5, along=10, shift=(2.3, -1.7)),
    _Flight("20260626", 44100, planned=92, strips=6, along=10, shift=(-1.9, 2.4)),
)


@dataclass(frozen=True)
class Plan:
    """A flight before it is rendered."""

    mount: Mount
    anomalies: list[dict[str, Any]]
    fixes: list[Fix]
    """Of the photographs, with the receiver's errors."""
    thermal_fixes: list[Fix]
    bias: Array
    """The receiver's error that stays [m], [3]."""
    origin: Fix = _ORIGIN


def flight_mount(date: int, variant: Variant) -> Plan:
    """The block on a date, the path over it and the two cameras."""
    seed = 3 if variant.seed is None else variant.seed
    flight = _FLIGHTS[date]
    scene, anomalies = block(seed, date)
    poses = flight_poses(seed, date, variant.views)
    metered = len(poses) // 3
    if variant.views is None:
        poses = poses[: flight.landed]
    seconds = [flight.start + _SECONDS * k for k in range(len(poses))]
    clock = [f"{s // 3600:02d}{s // 60 % 60:02d}{s % 60:02d}" for s in seconds]
    names = [f"DJI_{flight.day}{time}_{k + 1:04d}" for k, time in enumerate(clock)]
    mount = Mount(
        scene,
        poses,
        _lens(1024, 768, 66.0, -0.09, 0.02, margin=1.16),
        _lens(640, 512, 46.0, -0.21, 0.06, margin=1.26),
        turn=(0.7, -1.1, 0.4),
        offset=(0.031, 0.012, -0.004),
        photographs=[f"{name}_V.JPG" for name in names],
        thermal_images=[f"{name}_T.tiff" for name in names],
        samples=(40, 28),
        seeds=(seed, date),
        jpeg=87,
        metered=metered,
        drift=None,
        jump_every=24,
    )
    random = mount.rng(8)
    bias = random.normal(0, 1.0, 3) * (1, 1, 1.6)
    fixes = [_fix(pose[:3, 3], bias, random) for pose in poses]
    again = mount.rng(7)
    return Plan(mount, anomalies, fixes, [_fix(pose[:3, 3], bias, again) for pose in poses], bias)


def flight_poses(seed: int, date: int, views: int | None = None) -> list[Array]:
    """Strips from above, then the four sides aslant: camera to world in Mitsuba's axes.

    Args:
        seed: Draws the wind.
        date: 0, 1 or 2, each along strips of its own.
        views: About how many; None: as planned.
    """
    flight = _FLIGHTS[date]
    density = 1.0 if views is None else views / flight.planned
    random, stations = np.random.default_rng([seed, date, 5]), []
    for k, y in enumerate(np.linspace(-DEPTH / 2, DEPTH / 2, flight.strips)):
        xs = np.linspace(-WIDTH / 2 - 2, WIDTH / 2 + 2, _several(flight.along, density))
        for x in xs if k % 2 == 0 else xs[::-1]:
            stations.append((x + flight.shift[0], y + flight.shift[1], _ALTITUDE, 0 if k % 2 == 0 else 180, -88))
    for yaw, x, y, dx, dy in (
        (90, -WIDTH / 2, -DEPTH / 2 - 24, 1, 0),
        (270, WIDTH / 2, DEPTH / 2 + 24, -1, 0),
        (0, -WIDTH / 2 - 26, -DEPTH / 2, 0, 1),
        (180, WIDTH / 2 + 26, DEPTH / 2, 0, -1),
    ):
        for t in np.linspace(0, WIDTH if dx else DEPTH, _several(9 if dx else 7, density)):
            stations.append((x + dx * t, y + dy * t, _ALTITUDE - 4, yaw, -48))
    return [
        _aimed(
            np.array([x, y, z]) + random.normal(0, 0.35, 3), yaw + random.normal(0, 1.2), pitch + random.normal(0, 0.8)
        )
        for x, y, z, yaw, pitch in stations
    ]


def _several(published: int, density: float) -> int:
    return max(round(published * density), 1)


def _aimed(place: Array, yaw: float, pitch: float) -> Array:
    """A pose from angles [degrees]: yaw from east to north, pitch upwards."""
    y, p = np.radians([yaw, pitch])
    forward = np.array([np.cos(p) * np.cos(y), np.cos(p) * np.sin(y), np.sin(p)])
    left = np.array([-np.sin(y), np.cos(y), 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = left, np.cross(forward, left), forward, place
    return pose


def _lens(width: int, height: int, fov: float, k1: float, k2: float, margin: float) -> Lens:
    focal = float(width / (2 * np.tan(np.radians(fov) / 2)))
    return Lens(width, height, focal, width / 2 + 3.5, height / 2 - 4.0, k1, k2, margin)


def _fix(place: Array, bias: Array, random: np.random.Generator) -> Fix:
    """What the receiver says: errors that stay, and errors of each fix [m]."""
    east, north, up = place + bias + random.normal(0, 0.25, 3) * (1, 1, 1.5)
    latitude, longitude, altitude = _ORIGIN
    per_degree = 111320.0 * np.cos(np.radians(latitude))  # of longitude; of latitude 111,173 m at 47 degrees north
    return (float(latitude + north / 111173.0), float(longitude + east / per_degree), float(altitude + up))


def photograph_exif(name: str, fix: Fix, lens: Lens) -> bytes:
    """Time, position and focal length of a photograph, as its metadata."""
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    day, time = name.split("_")[1][:8], name.split("_")[1][8:]
    when = f"{day[:4]}:{day[4:6]}:{day[6:]} {time[:2]}:{time[2:4]}:{time[4:]}"

    def degrees(value: float) -> tuple[Any, ...]:
        seconds = IFDRational(round(value * 3600 % 60 * 10000), 10000)
        return (IFDRational(int(value), 1), IFDRational(int(value * 60 % 60), 1), seconds)

    exif = Image.Exif()
    exif[271], exif[272], exif[306] = "rendered", "flight", when
    exif.get_ifd(0x8769).update({36867: when, 41989: round(lens.focal * 36.0 / lens.width)})
    latitude, longitude, altitude = fix
    where = {1: "N", 2: degrees(latitude), 3: "E", 4: degrees(longitude), 5: b"\x00"}
    exif.get_ifd(0x8825).update({**where, 6: IFDRational(round(altitude * 1000), 1000)})
    return exif.tobytes()
