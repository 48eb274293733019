"""Positions in tables beside the images, as several programs write them."""

from pathlib import Path

import pytest

from camera_folders import write_two_cameras
from thermosplat.prepare.importing.position_tables import with_tables
from thermosplat.prepare.importing.source_files import read_folder

Position = tuple[float | None, float | None, float | None]


def positions(folder: Path) -> tuple[dict[str, Position], str]:
    """Latitude, longitude and altitude of each file, and what was said."""
    files, said = with_tables(read_folder(folder).files, folder)
    return {file.path.name: (file.exif.latitude, file.exif.longitude, file.exif.altitude) for file in files}, " ".join(
        said
    )


@pytest.mark.parametrize(
    ("name", "text", "altitude"),
    [
        ("thermal/gps.csv", "name,latitude,longitude,altitude\nIR_0002.tiff,47.5,-8.25,488.5\n", 488.5),
        ("geo.csv", "#Label;X/Longitude;Y/Latitude;Z/Altitude\nIR_0002;-8,25;47,5;488,5\n", 488.5),
        ("thermal/a.csv", "Image Name\tLon\tLat\nC:\\flight\\IR_0002.TIFF\t-8.25\t47.5\n", None),
        ("geo.txt", "EPSG:4326\nIR_0002.tiff -8.25 47.5 488.5 0 0 0\n", 488.5),
        (
            "exif.csv",
            "SourceFile,GPSAltitude,GPSLatitude,GPSLongitude\n./thermal/IR_0002.tiff,3.5 m Below Sea Level,"
            '"47 deg 30\' 0.00"" N","8 deg 15\' 0.00"" W"\n',
            -3.5,
        ),
    ],
)
def test_tables(tmp_path: Path, name: str, text: str, altitude: float | None) -> None:
    """Names with and without folders and endings, decimal commas, degrees with minutes; other images have none."""
    write_two_cameras(tmp_path, 3)
    (tmp_path / name).write_text(text)
    found, said = positions(tmp_path)
    assert found["IR_0002.tiff"] == (47.5, -8.25, altitude)
    assert found["IR_0001.tiff"] == found["VIS_0002.jpg"] == (None, None, None)
    assert f"{name} states the position of 1 image." in said


def test_lines_without_a_position(tmp_path: Path) -> None:
    """Columns that are swapped, no fix and words are left out and said; a table of something else is not looked at."""
    write_two_cameras(tmp_path, 4)
    lines = ["file,lat,lon", "IR_0001.tiff,119.8,36.7", "IR_0002.tiff,0,0", "IR_0003.tiff,none,", "IR_0004.tiff,1,2"]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    (tmp_path / "b.csv").write_text("name,temperature\nIR_0001.tiff,20\n")
    (tmp_path / "c.csv").write_bytes(bytes(range(256)) * 20)
    found, said = positions(tmp_path)
    assert found["IR_0004.tiff"] == (1, 2, None)
    assert [place for place, *_ in found.values()].count(None) == 7
    assert "3 lines of a.csv without a position (first: IR_0001.tiff 119.8 36.7)" in said
    assert "b.csv" not in said


def test_each_table_is_for_its_own_folder(tmp_path: Path) -> None:
    """The same names in two folders, each with a table."""
    for number, folder in enumerate(("100MEDIA", "101MEDIA")):
        write_two_cameras(tmp_path / folder, 2)
        (tmp_path / folder / "gps.csv").write_text(f"name,lat,lon\nIR_0001.tiff,{number + 10},20\n")
    files, _ = with_tables(read_folder(tmp_path).files, tmp_path)
    placed = {file.name: file.exif.latitude for file in files if file.exif.latitude is not None}
    assert placed == {"100MEDIA/thermal/IR_0001.tiff": 10, "101MEDIA/thermal/IR_0001.tiff": 11}
