"""EXIF data, as Pillow writes it."""

from pathlib import Path

import pytest

from thermosplat.prepare.capture_folder import Exif
from thermosplat.prepare.importing.exif import parse_exif, read_exif

Image = pytest.importorskip("PIL.Image")
IFDRational = pytest.importorskip("PIL.TiffImagePlugin").IFDRational

DATE, MAKE, MODEL, ORIENTATION, EXIF_IFD, GPS_IFD = 0x0132, 0x010F, 0x0110, 0x0112, 0x8769, 0x8825


def write(path: Path, main: dict[int, object], inner: dict[int, object], gps: dict[int, object]) -> Path:
    """An image with these tags."""
    exif = Image.Exif()
    exif.update(main)
    exif.get_ifd(EXIF_IFD).update(inner)
    exif.get_ifd(GPS_IFD).update(gps)
    Image.new("RGB", (8, 6)).save(path, exif=exif)
    return path


def test_everything_is_read(tmp_path: Path) -> None:
    """Time with subseconds and zone, place on all sides of zero, focal lengths, camera, orientation; JPEG and TIFF."""
    path = write(
        tmp_path / "a.jpg",
        {MAKE: "Maker", MODEL: "Model 1", ORIENTATION: 6, DATE: "2001:01:01 00:00:00"},
        {0x9003: "2024:10:30 10:50:43", 0x9291: "678", 0x9011: "+02:00", 0x920A: IFDRational(35, 10), 0xA405: 24},
        {
            1: "S",
            2: tuple(IFDRational(part) for part in (55, 41, 30)),
            3: "W",
            4: tuple(IFDRational(part) for part in (13, 11, 0)),
            5: b"\x01",
            6: IFDRational(385, 10),
        },
    )
    found = read_exif(path)
    assert found.time == "2024-10-30T10:50:43.678+02:00"
    assert found.latitude == pytest.approx(-(55 + 41.5 / 60))
    assert found.longitude == pytest.approx(-(13 + 11 / 60))
    assert (found.altitude, found.focal_length_mm, found.focal_length_35mm) == (-38.5, 3.5, 24.0)
    assert (found.make, found.model, found.orientation) == ("Maker", "Model 1", 6)
    content = path.read_bytes()
    (tmp_path / "a.tiff").write_bytes(content[content.index(b"Exif\0\0") + 6 :])  # the segment is a TIFF
    assert read_exif(tmp_path / "a.tiff") == found


def test_second_best_times(tmp_path: Path) -> None:
    """The date of the file where there is none of the exposure; Workswell's subseconds; nonsense is none."""
    assert read_exif(write(tmp_path / "a.jpg", {DATE: "2001:01:01 00:00:07"}, {}, {})).time == "2001-01-01T00:00:07"
    path = write(tmp_path / "b.jpg", {}, {0x9003: "2001:01:01 00:00:07", 0x9291: "782/1000"}, {})
    assert read_exif(path).time == "2001-01-01T00:00:07.782"
    assert read_exif(write(tmp_path / "c.jpg", {DATE: "0000:00:00 00:00:00"}, {}, {})).time is None


def test_damaged_data_is_none(tmp_path: Path) -> None:
    """No file, no EXIF, and a file that is cut off anywhere never raise."""
    assert read_exif(tmp_path / "none.jpg") == Exif()
    Image.new("RGB", (8, 6)).save(tmp_path / "plain.png")
    assert read_exif(tmp_path / "plain.png") == Exif()
    whole = write(tmp_path / "a.jpg", {MAKE: "Maker" * 9}, {0x9003: "2024:10:30 10:50:43"}, {}).read_bytes()
    for end in range(len(whole)):
        parse_exif(whole[:end])
    start = whole.index(b"Exif\0\0") + 6
    for at in range(start, start + 60):
        parse_exif(whole[:at] + b"\xff\xff" + whole[at + 2 :])
