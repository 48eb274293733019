"""What drones write as XMP."""

import struct
from pathlib import Path

import pytest

from camera_folders import exif_segment, write_photograph, write_two_cameras
from thermosplat.prepare.capture_folder import CaptureFolder, Exif
from thermosplat.prepare.importing.exif import parse_exif
from thermosplat.prepare.importing.flight_data import with_flight_data
from thermosplat.prepare.importing.import_files import import_files

ATTRIBUTES = (
    '<rdf:Description drone-dji:GpsStatus="RTK" drone-dji:GpsLatitude="+47.05099469" '
    'drone-dji:GpsLongtitude="-8.3059864" drone-dji:AbsoluteAltitude="+488.540" drone-dji:RelativeAltitude="+36.5" '
    'drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.011" drone-dji:RtkStdLat="0.013" drone-dji:RtkStdHgt="0.027" '
    'drone-dji:GimbalYawDegree="-91.30" drone-dji:GimbalPitchDegree="-89.90" drone-dji:GimbalRollDegree="+0.00"/>'
)
ELEMENTS = (
    "<drone-dji:GpsLatitude>+47.05099469</drone-dji:GpsLatitude><drone-dji:GpsLongitude>-8.3059864</drone-dji:"
    "GpsLongitude><drone-dji:AbsoluteAltitude>488.54</drone-dji:AbsoluteAltitude>"
)


def jpeg(packet: str) -> bytes:
    """The beginning of a JPEG with this XMP, and with EXIF data."""
    body = b"http://ns.adobe.com/xap/1.0/\0" + packet.encode()
    return (
        b"\xff\xd8"
        + exif_segment(make="DJI", iso=100, zoom=2.0)
        + b"\xff\xe1"
        + struct.pack(">H", len(body) + 2)
        + body
    )


def test_position_receiver_and_gimbal() -> None:
    """Attributes, DJI's misspelling included, and elements."""
    found = parse_exif(jpeg(ATTRIBUTES))
    assert (found.latitude, found.longitude, found.altitude) == (47.05099469, -8.3059864, 488.54)
    assert (found.relative_altitude, found.rtk_flag, found.position_std, found.altitude_std) == (36.5, 50, 0.013, 0.027)
    assert (found.gimbal_yaw, found.gimbal_pitch, found.gimbal_roll) == (-91.3, -89.9, 0.0)
    assert (found.make, found.iso, found.digital_zoom) == ("DJI", 100, 2.0)
    other = parse_exif(jpeg(ELEMENTS))
    assert (other.latitude, other.longitude, other.altitude) == (47.05099469, -8.3059864, 488.54)


@pytest.mark.parametrize(
    "packet",
    [
        "",
        '<x drone-dji:GpsLatitude="0" drone-dji:GpsLongitude="0.0" drone-dji:AbsoluteAltitude="3"/>',
        ATTRIBUTES.replace('GpsStatus="RTK"', 'GpsStatus="Invalid"'),
        '<x drone-dji:GpsLatitude="147.1" drone-dji:GpsLongitude="8.3"/>',
        '<x drone-dji:GpsLatitude="nan" drone-dji:GpsLongitude="8.3"/>',
        '<x drone-dji:GpsLatitude="47.1"/>',
        "<!ENTITY a 'b'><x drone-dji:GpsLatitude=&a; drone-dji:GpsLongitude=&a;/>",
    ],
)
def test_no_position(packet: str) -> None:
    """No fix, impossible angles and half a position are none."""
    found = with_flight_data(Exif(), packet.encode())
    assert (found.latitude, found.longitude, found.altitude) == (None, None, None)


def test_positions_of_a_capture(tmp_path: Path) -> None:
    """They are in frames.csv, and the import says how many have one and where RTK was lost."""
    folder = write_two_cameras(tmp_path / "in", 6)
    for number in range(1, 6):
        path = write_photograph(folder / "visible" / f"VIS_{number:04d}.jpg", number)
        xmp = ATTRIBUTES if number < 4 else ATTRIBUTES.replace('RtkFlag="50"', 'RtkFlag="16"')
        path.write_bytes(jpeg(xmp) + path.read_bytes()[2:])
    capture = CaptureFolder(tmp_path / "out")
    write_photograph(folder / "visible" / "VIS_0006.jpg", 6, make="DJI")
    (folder / "thermal" / "gps.csv").write_text("file,lat,lon\nIR_0001,47,8\nIR_0002,47,8\n")
    said = " ".join(import_files(folder, capture).sentences)
    assert "5 of 6 RGB images and 2 of 6 thermal images have a GPS position." in said
    assert "RTK was not fixed in 2 images." in said
    first = capture.read_frames("rgb")[0]
    assert (first.latitude, first.rtk_flag, first.gimbal_pitch) == (47.05099469, 50, -89.9)
    assert capture.read_frames("rgb")[5].latitude is None
