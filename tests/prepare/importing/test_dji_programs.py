"""Counts in DJI's files, converted by programs that stand in for those that a user installs."""

import json
import stat
import sys
from pathlib import Path

import numpy as np
import pytest

from camera_folders import write_photograph
from dji_jpeg import linear, warm, white_hot, write_dji_jpeg
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.importing.dji_files import read_dji
from thermosplat.prepare.importing.dji_programs import CLI, IRP, converted
from thermosplat.prepare.importing.import_files import import_files
from thermosplat.prepare.importing.import_options import ImportOptions
from thermosplat.prepare.importing.thermal_images import ThermalOptions
from thermosplat.thermal.thermal_parameters import read_parameters

VALUES = """
def values(path):
    content, at, found = open(path, "rb").read(), 2, b""
    while content[at + 1] != 0xDA:
        length = int.from_bytes(content[at + 2 : at + 4], "big")
        found += content[at + 4 : at + 2 + length] if content[at + 1] == 0xE3 else b""
        at += 2 + length
    return array.array("f", [stored / 64 - 273.15 + 5 for stored in array.array("H", found)])
"""
"""What both make of a file: what it stores, and 5 °C more."""
IRP_BODY = """
words = sys.argv[1:]
assert words[:1] == ["-s"] and words[2:6] == ["-a", "measure", "--measurefmt", "float32"] and words[6] == "-o", words
assert os.environ["LD_LIBRARY_PATH"].split(":")[0] == os.path.dirname(os.path.realpath(sys.argv[0]))
values(words[1]).tofile(open(words[7], "wb"))
"""
CLI_BODY = """
import cv2, numpy as np, pathlib
open(__file__ + ".calls", "a").write("once ")
words = sys.argv[1:]
assert words[0] == "process" and words[5:] == ["-o", "temp_c:tiff", "--distance", "embedded"], words
options = dict(zip(words[1::2], words[2::2]))
out = pathlib.Path(options["--output-dir"]); out.mkdir()
for path in sorted(pathlib.Path(options["--input-dir"]).iterdir()):
    cv2.imwrite(str(out / (path.stem + "_temp_c.tiff")), np.array(values(path), "f4").reshape(128, 160))
"""
COUNTED = linear(warm(1)) | np.uint16(1)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Puts programs on a PATH of their own."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))

    def put(name: str, body: str) -> Path:
        program = folder / name
        program.write_text(f"#!{sys.executable}\nimport array, os, sys\n{VALUES}\n{body}")
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
        return program

    return put


def write_flight(folder: Path, layouts: str = "hhhhh") -> Path:
    """Pairs of five moments; h has counts, i temperatures."""
    for number, layout in enumerate(layouts):
        stored = linear(warm(number)) | np.uint16(layout == "h")
        write_dji_jpeg(folder / f"DJI_{number:04d}_T.JPG", stored, "hirp" if layout == "h" else "iirp")
        write_photograph(folder / f"DJI_{number:04d}_W.JPG", number)
    return folder


@pytest.mark.parametrize(("name", "body"), [(IRP, IRP_BODY), (CLI, CLI_BODY)])
def test_both_programs_are_called_and_read(tmp_path: Path, install, name: str, body: str) -> None:
    """As their documents say: with the file's own distance, and one call for all where the program takes several."""
    program = install(name, body)
    paths = [write_dji_jpeg(tmp_path / folder / "a.jpg", COUNTED, "hirp") for folder in "xyz"]
    with converted(paths) as conversion:
        for path in paths:
            assert np.abs(conversion.celsius(read_dji(path)) - warm(1) - 5).max() < 0.1
    assert set(conversion.programs.values()) == {name}
    if name == CLI:
        assert program.with_name(f"{CLI}.calls").read_text() == "once "


def test_the_second_program_takes_what_the_first_cannot_read(tmp_path: Path, install) -> None:
    """File by file; where both fail, both are quoted with what they call an error, not with their last line."""
    irp = (
        "print('Run error: ret = -17 (ERROR in R-JPEG)'); print('Done.'); sys.exit(252 if 'bad' in sys.argv[2] else 0)"
    )
    install(IRP, IRP_BODY + irp)
    paths = [write_dji_jpeg(tmp_path / name, COUNTED, "hirp") for name in ("good.jpg", "bad.jpg")]
    with (
        converted(paths) as alone,
        pytest.raises(UserError, match=r"bad.jpg cannot .*dji_irp: exit code 252: Run error"),
    ):
        alone.celsius(read_dji(paths[1]))
    install(CLI, CLI_BODY)
    with converted(paths) as conversion:
        assert [conversion.programs[path] for path in paths] == [IRP, CLI]
        assert np.abs(conversion.celsius(read_dji(paths[1])) - warm(1) - 5).max() < 0.1
    install(CLI, "print('ERROR 000000.jpg: no calibration'); print('Done. 0 files processed.'); sys.exit(1)")
    with (
        converted(paths) as conversion,
        pytest.raises(UserError, match=r"252: .*; dji-thermal-cli: exit code 1: ERROR bad.jpg"),
    ):
        conversion.celsius(read_dji(paths[1]))


@pytest.mark.parametrize(
    ("body", "pattern"),
    [
        ("sys.exit('no such camera')", "exit code 1: no such camera"),
        ("pass", "it said nothing"),
        ("array.array('f', [0] * 7).tofile(open(sys.argv[8], 'wb'))", "wrote 7 values for a sensor of 160x128 px"),
        ("array.array('f', [-273.15] * 160 * 128).tofile(open(sys.argv[8], 'wb'))", "are no temperatures"),
        ("array.array('f', list(values(sys.argv[2]))[::-1]).tofile(open(sys.argv[8], 'wb'))", "shows something else"),
    ],
)
def test_programs_that_fail(tmp_path: Path, install, body: str, pattern: str) -> None:
    """Each way is an error with the file's name, temperatures of another picture included."""
    install(IRP, body)
    path = write_dji_jpeg(tmp_path / "a.jpg", COUNTED, "hirp")
    with converted([path]) as conversion, pytest.raises(UserError, match=rf"a\.jpg cannot .*{pattern}"):
        conversion.celsius(read_dji(path))


@pytest.mark.parametrize("floor", [-273.15, -273.0])
def test_pixels_without_a_temperature(tmp_path: Path, install, floor: float) -> None:
    """The program writes its floor there."""
    install(IRP, IRP_BODY.replace("values(words[1])", f"(values(words[1])[:-3] + array.array('f', [{floor}] * 3))"))
    path = write_dji_jpeg(tmp_path / "a.jpg", COUNTED, "hirp")
    with converted([path]) as conversion:
        assert np.isnan(conversion.celsius(read_dji(path))).sum() == 3


def test_import_says_who_converted_and_for_what(tmp_path: Path, install) -> None:
    """Program, emissivity and distance; the parameters are kept as applied."""
    install(CLI, CLI_BODY)
    capture = CaptureFolder(tmp_path / "out")
    said = " ".join(import_files(write_flight(tmp_path / "in"), capture).sentences)
    assert "Counts of DJI M3T files were converted by dji-thermal-cli, for an emissivity of 0.95 and 5.0 m" in said
    stored = read_image(capture.images("thermal") / "DJI_0003_T.png") / 100 - 273.15
    assert np.abs(stored - warm(3) - 5).max() < 0.1
    parameters = read_parameters(capture.thermal_parameters)
    assert {(one.applied, one.emissivity, one.distance_metres) for one in parameters.values()} == {(True, 0.95, 5.0)}


def test_temperatures_and_counts_in_one_folder(tmp_path: Path, install) -> None:
    """One way for all: what programs correct is not mixed with what is uncorrected."""
    folder = write_flight(tmp_path / "in", "iihii")
    with pytest.raises(UserError, match="1 of 5 DJI M3T files holds sensor counts and no temperatures") as caught:
        import_files(folder, CaptureFolder(tmp_path / "out"))
    assert "pipx install dji-thermal-cli" in str(caught.value.hint)
    assert "--palette grey, from which they lie 0." in str(caught.value.hint)
    install(CLI, CLI_BODY)
    capture = CaptureFolder(tmp_path / "out")
    import_files(folder, capture)
    for number in range(5):
        stored = read_image(capture.images("thermal") / f"DJI_{number:04d}_T.png") / 100 - 273.15
        assert np.abs(stored - warm(number) - 5).max() < 0.1


def test_pictures_of_counts_are_taken_where_the_user_says_how(tmp_path: Path, install) -> None:
    """Without a program, the palette or its range makes values of the pictures."""
    capture = CaptureFolder(tmp_path / "out")
    options = ImportOptions(thermal=ThermalOptions(palette="grey"))
    said = " ".join(import_files(write_flight(tmp_path / "in"), capture, options).sentences)
    assert "They are no temperatures" in said
    stored = read_image(capture.images("thermal") / "DJI_0003_T.png")
    assert np.abs(stored / 257 - white_hot(linear(warm(3)))[..., 0]).mean() < 8
    assert json.loads(capture.units_json.read_text()) == {"unit": "counts"}
    assert not capture.thermal_parameters.exists()


def test_files_that_fail_are_left_out_where_the_user_says_so(tmp_path: Path, install) -> None:
    """One file whose picture shows something else stops the import, or is named and left out."""
    folder = write_flight(tmp_path / "in", "iiiiiii")
    write_dji_jpeg(folder / "DJI_0002_T.JPG", linear(warm(2)), picture=white_hot(warm(9)))
    with pytest.raises(UserError, match=r"DJI_0002_T.JPG cannot be right") as caught:
        import_files(folder, CaptureFolder(tmp_path / "out"))
    assert "--skip-unreadable" in str(caught.value.hint)
    capture = CaptureFolder(tmp_path / "out")
    said = " ".join(import_files(folder, capture, ImportOptions(skip_unreadable=True)).sentences)
    assert "1 thermal file was left out (first: The temperatures in" in said
    assert "correct them for an emissivity of 0.95, 25 °C reflected and 5.0 m; nothing is corrected here" in said
    assert len(capture.read_frames("thermal")) == 6
