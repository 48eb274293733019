"""DJI's radiometric JPEGs, with programs that stand in for those that a user installs."""

import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest

from camera_folders import exif_segment, write_photograph
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.importing.dji_files import is_dji_thermal, read_dji
from thermosplat.prepare.importing.import_files import import_files

IRP = """
words = sys.argv[1:]
assert words[:1] == ["-s"] and words[2:6] == ["-a", "measure", "--measurefmt", "float32"] and words[6] == "-o", words
assert open(words[1], "rb").read(2) == bytes([0xFF, 0xD8])
assert os.environ["LD_LIBRARY_PATH"].split(":")[0] == os.path.dirname(os.path.realpath(sys.argv[0]))
array.array("f", [10 + 30 * i / (36 * 48 - 1) for i in range(36 * 48)]).tofile(open(words[7], "wb"))
"""
CLI = """
import cv2, numpy as np, pathlib
words = sys.argv[1:]
assert words[0] == "process" and words[5:] == ["-o", "temp_c:tiff"], words
options = dict(zip(words[1::2], words[2::2]))
out = pathlib.Path(options["--output-dir"]); out.mkdir()
for path in pathlib.Path(options["--input-dir"]).iterdir():
    cv2.imwrite(str(out / (path.stem + "_temp_c.tiff")), np.linspace(10, 40, 36 * 48, dtype="f4").reshape(36, 48))
"""


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, body: str) -> None:
    """Put a program on the PATH, as the only one there."""
    folder.mkdir(exist_ok=True)
    program = folder / name
    program.write_text(f"#!{sys.executable}\nimport array, os, sys\n{body}")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(folder))


def write_dji(path: Path, number: int) -> Path:
    """A JPEG with DJI's name and a segment APP3."""
    content = write_photograph(path, number, size=(48, 36)).read_bytes()
    path.write_bytes(content[:2] + exif_segment(make="DJI", model="M3T") + b"\xff\xe3\x00\x04ab" + content[2:])
    return path


def test_dji_files_are_told_by_maker_and_segment(tmp_path: Path) -> None:
    """The maker and the segment together."""
    content = write_dji(tmp_path / "a.jpg", 1).read_bytes()
    assert is_dji_thermal(content, "DJI")
    assert not is_dji_thermal(content, "FLIR")
    assert not is_dji_thermal(write_photograph(tmp_path / "b.jpg", 1).read_bytes(), "DJI")


@pytest.mark.parametrize(("name", "body"), [("dji_irp", IRP), ("dji-thermal-cli", CLI)])
def test_both_programs_are_called_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, body: str
) -> None:
    """Both are called as their documents say, and what they write is read."""
    install(tmp_path / "bin", monkeypatch, name, body)
    expected = np.linspace(10, 40, 36 * 48).reshape(36, 48)
    assert read_dji(write_dji(tmp_path / "a.jpg", 1), 48, 36) == pytest.approx(expected, abs=1e-4)


def test_import_calls_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Temperatures in DJI's files become those of the capture."""
    install(tmp_path / "bin", monkeypatch, "dji_irp", IRP)
    expected = np.linspace(10, 40, 36 * 48).reshape(36, 48)
    for number in range(5):
        write_dji(tmp_path / "in" / f"DJI_{number}_T.JPG", number)
        write_photograph(tmp_path / "in" / f"DJI_{number}_W.JPG", number)
    capture = CaptureFolder(tmp_path / "out")
    import_files(tmp_path / "in", capture)
    stored = read_image(capture.images("thermal") / "DJI_3_T.png") / 100 - 273.15
    assert np.abs(stored - expected).max() < 0.006


@pytest.mark.parametrize("floor", [-273.15, -273.0])
def test_pixels_without_a_temperature(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, floor: float) -> None:
    """The program writes its floor there; the import fills them from their neighbours."""
    written = 'np.linspace(10, 40, 36 * 48, dtype="f4")'
    floored = CLI.replace(written, f'np.append(np.linspace(10, 40, 36 * 48 - 3), [{floor}] * 3).astype("f4")')
    assert floored != CLI
    install(tmp_path / "bin", monkeypatch, "dji-thermal-cli", floored)
    celsius = read_dji(write_dji(tmp_path / "a_T.JPG", 1), 48, 36)
    assert np.isnan(celsius).sum() == 3
    assert np.nanmin(celsius) == 10


def test_without_a_program_both_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sentence that names both."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"neither dji_irp nor dji-thermal-cli is on the PATH"):
        read_dji(write_dji(tmp_path / "a.jpg", 1), 48, 36)


@pytest.mark.parametrize(
    ("body", "pattern"),
    [
        ("sys.exit('no such camera')", "exit code 1: no such camera"),
        ("pass", "it wrote nothing"),
        ("array.array('f', [0] * 7).tofile(open(sys.argv[8], 'wb'))", "it wrote 7 values for a picture of 48x36"),
        ("array.array('f', [-273.15] * 36 * 48).tofile(open(sys.argv[8], 'wb'))", "are no temperatures"),
    ],
)
def test_programs_that_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, pattern: str) -> None:
    """Each way is an error with the file's name."""
    install(tmp_path / "bin", monkeypatch, "dji_irp", body)
    with pytest.raises(UserError, match=rf"dji_irp cannot read .*a.jpg: .*{pattern}"):
        read_dji(write_dji(tmp_path / "a.jpg", 1), 48, 36)
    assert os.environ["PATH"] == str(tmp_path / "bin")
