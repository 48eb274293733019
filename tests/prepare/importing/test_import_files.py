"""Importing: which files are found in which folders, what becomes of them, and what is refused."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_folders import celsius, centikelvin, exif_segment, scene, write_photograph, write_two_cameras, write_values
from flir_jpeg import write_flir_jpeg
from thermosplat.datasets.images.image_files import read_image
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.importing import import_files as module
from thermosplat.prepare.importing.import_files import import_files
from thermosplat.prepare.importing.import_options import ImportOptions
from thermosplat.prepare.importing.thermal_images import ThermalOptions
from thermosplat.printing import printable
from thermosplat.thermal.radiometry import FLIR_IRON
from tiff_files import NODATA, ORIENTATION, tiff_file

COUNTS = (12_000 + np.arange(36 * 48)).astype(np.uint16).reshape(36, 48)


@pytest.fixture
def capture(tmp_path: Path) -> CaptureFolder:
    return CaptureFolder(tmp_path / "capture")


def names(capture: CaptureFolder, spectrum: str) -> list[str]:
    return [row.file for row in capture.read_frames(spectrum)]


def test_photographs_and_thermal_files_from_two_folders(tmp_path: Path, capture: CaptureFolder) -> None:
    """Photographs are the very files, thermal values keep their temperatures, and the table says where from."""
    report = import_files(write_two_cameras(tmp_path / "in"), capture)
    assert "6 RGB images of 96x72 px and 6 thermal images of 48x36 px." in report.sentences
    assert names(capture, "rgb") == [f"VIS_{number:04d}.jpg" for number in range(1, 7)]
    for number, row in enumerate(capture.read_frames("thermal"), start=1):
        assert (row.source, row.width, row.height) == (f"thermal/IR_{number:04d}.tiff", 48, 36)
        assert np.array_equal(read_image(capture.images("thermal") / row.file), centikelvin(number))
    photograph = capture.images("rgb") / "VIS_0001.jpg"
    assert photograph.read_bytes() == (tmp_path / "in" / "visible" / "VIS_0001.jpg").read_bytes()
    assert json.loads(capture.units_json.read_text()) == {"unit": "centikelvin"}
    assert import_files(tmp_path / "in", capture).before


@pytest.mark.parametrize(
    ("photograph", "thermal"),
    [
        ("RGB/{}.jpg", "IR/{}.tiff"),
        ("VisJPG/{}-visible.jpg", "RadTIFF/{}-radiometric.tiff"),
        ("DJI_{}_W.jpg", "DJI_{}_T.tiff"),
        ("a/{}_rgb.jpg", "b/{}_lwir.png"),
        ("{}.jpg", "{}.tiff"),
    ],
)
def test_arrangements(tmp_path: Path, capture: CaptureFolder, photograph: str, thermal: str) -> None:
    """Folders, suffixes and mixed folders, as cameras and programs write them."""
    for number in range(1, 6):
        write_photograph(tmp_path / "in" / photograph.format(f"{number:04d}"), number)
        write_values(tmp_path / "in" / thermal.format(f"{number:04d}"), centikelvin(number))
    import_files(tmp_path / "in", capture)
    assert len(names(capture, "rgb")) == len(names(capture, "thermal")) == 5


def test_flir_files_alone(tmp_path: Path, capture: CaptureFolder) -> None:
    """Photographs come out of the radiometric files, under the names of their thermal images."""
    for number in range(5):
        path = tmp_path / "in" / f"FLIR{number:04d}.jpg"
        content = write_flir_jpeg(path, COUNTS + number, photograph=scene(number, 96, 72)).read_bytes()
        path.write_bytes(content[:2] + exif_segment(make="FLIR", focal_length=6.5) + content[2:])
    import_files(tmp_path / "in", capture)
    assert names(capture, "rgb") == [f"FLIR{number:04d}.jpg" for number in range(5)]
    assert [Path(name).stem for name in names(capture, "thermal")] == [f"FLIR{number:04d}" for number in range(5)]
    assert {row.focal_length_mm for row in capture.read_frames("rgb")} == {None}  # EXIF has the thermal lens's
    assert {row.focal_length_mm for row in capture.read_frames("thermal")} == {6.5}
    shown = read_image(capture.images("rgb") / "FLIR0003.jpg")
    assert np.abs(shown.astype(int) - scene(3, 96, 72)).mean() < 8


def test_radiometric_files_are_preferred(tmp_path: Path, capture: CaptureFolder) -> None:
    """Pictures of the same temperatures, zoomed photographs and MSX are left out, and that is said."""
    write_two_cameras(tmp_path / "in")
    for number in range(6):
        write_photograph(tmp_path / "in" / "thermal" / f"IR_{number:04d}.jpg", number)
        write_photograph(tmp_path / "in" / f"X_{number}_Z.jpg", number)
        write_photograph(tmp_path / "in" / f"X_{number}_msx.jpg", number)
    said = " ".join(import_files(tmp_path / "in", capture).sentences)
    assert len(names(capture, "rgb")) == len(names(capture, "thermal")) == 6
    assert "6 thermal pictures without temperatures were left out" in said
    assert "6 images of the zoom camera" in said
    assert "6 images with visible edges (MSX)" in said


def test_pseudo_colour_is_inverted(tmp_path: Path, capture: CaptureFolder) -> None:
    """Colours of FLIR Iron become values, in °C where the ends are stated; with --keep-color they stay."""
    for number in range(5):
        write_photograph(tmp_path / "in" / f"P{number}.jpg", number)
        colors = np.rint(255 * FLIR_IRON.to_color((celsius(number) - 10) / 30)).astype(np.uint8)
        write_values(tmp_path / "in" / f"S{number}.png", colors[..., ::-1])
    span = ImportOptions(thermal=ThermalOptions(range=(10.0, 40.0)))
    said = " ".join(import_files(tmp_path / "in", capture, span).sentences)
    assert "inverse of FLIR Iron, which is assumed, from which they lie" in said
    stored = read_image(capture.images("thermal") / "S3.png") / 100 - 273.15
    assert np.abs(stored - celsius(3)).max() < 0.2
    import_files(tmp_path / "in", capture)
    assert json.loads(capture.units_json.read_text()) == {"unit": "counts"}
    import_files(tmp_path / "in", capture, ImportOptions(thermal=ThermalOptions(keep_color=True)))
    assert read_image(capture.images("thermal") / "S3.png").shape == (36, 48, 3)
    assert not capture.units_json.exists()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("IMG 0001 (2)", "IMG_0001_(2)"),
        ("a\n\x1b\u202eb", "a___b"),
        (os.fsdecode(b"caf\xe9"), "caf_"),
        ("温度", "温度"),
    ],
)
def test_names_become_plain(before: str, after: str, tmp_path: Path, capture: CaptureFolder) -> None:
    """COLMAP separates names by blanks, and tables are UTF-8: only what is printed stays."""
    folder = write_two_cameras(tmp_path / "in")
    for path in [path for path in folder.rglob("*") if path.is_file() and "0001" in path.name]:
        path.rename(path.with_name(before + path.suffix))
    import_files(folder, capture)
    photograph = next(row for row in capture.read_frames("rgb") if not row.file.startswith("VIS"))
    assert photograph.file == f"{after}.jpg"
    assert photograph.source == f"visible/{printable(before)}.jpg"
    assert (capture.images("rgb") / photograph.file).is_file()


def test_long_names_are_cut(tmp_path: Path, capture: CaptureFolder) -> None:
    """Names that are equal but for their folders get these in front, and numbers where that is too long."""
    for number in range(6):
        write_photograph(tmp_path / "in" / f"{number}{200 * 'f'}" / f"{200 * 'a'}.jpg", number)
        write_values(tmp_path / "in" / f"{number}{200 * 'f'}" / f"{200 * 't'}.tiff", centikelvin(number))
    import_files(tmp_path / "in", capture)
    assert len(set(names(capture, "rgb"))) == len(set(names(capture, "thermal"))) == 6


def test_a_video_whose_name_opencv_cannot_have(tmp_path: Path, capture: CaptureFolder) -> None:
    """OpenCV crashes at one that is not UTF-8."""
    (write_two_cameras(tmp_path / "in") / os.fsdecode(b"\xff.mp4")).write_bytes(b"video")
    with pytest.raises(UserError, match="is not UTF-8"):
        import_files(tmp_path / "in", capture)


def test_frames_of_a_video(tmp_path: Path, capture: CaptureFolder) -> None:
    """Every so many frames, with the time since the beginning."""
    for name, size in (("rgb.avi", (96, 72)), ("thermal.avi", (48, 36))):
        (tmp_path / "in").mkdir(exist_ok=True)
        writer = cv2.VideoWriter(str(tmp_path / "in" / name), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
        for number in range(12):
            grey = np.repeat(scene(number, *size)[..., 1:2], 3, -1)
            writer.write(grey if name == "thermal.avi" else scene(number, *size))
        writer.release()
    import_files(tmp_path / "in", capture, ImportOptions(every=2))
    rows = capture.read_frames("rgb")
    assert [row.source for row in rows] == [f"rgb.avi#{number}" for number in range(0, 12, 2)]
    assert (rows[3].file, rows[3].time) == ("rgb_000006.jpg", "1970-01-01T00:00:00.600")
    assert len(names(capture, "thermal")) == 6


def test_named_folders_and_further_spectra(tmp_path: Path, capture: CaptureFolder) -> None:
    """Folders that are named need no words in their names; photographs alone are enough then."""
    write_two_cameras(tmp_path / "in")
    (tmp_path / "in" / "visible").rename(tmp_path / "one")
    (tmp_path / "in" / "thermal").rename(tmp_path / "two")
    for number in range(1, 7):
        write_photograph(tmp_path / "three" / f"VIS_{number:04d}.jpg", number)
        write_photograph(tmp_path / "four" / f"{number}.jpg", number)
    folders = {"rgb": str(tmp_path / "one"), "thermal": str(tmp_path / "two"), "nir": str(tmp_path / "three")}
    said = " ".join(import_files(None, capture, ImportOptions(folders=folders)).sentences)
    assert [len(names(capture, name)) for name in folders] == [6, 6, 6]
    assert "6 of 6 NIR images have the name of a photograph and take its camera" in said
    with pytest.raises(UserError, match="None of the 6 NIR images has the name of a photograph"):
        import_files(None, CaptureFolder(tmp_path / "other"), ImportOptions({**folders, "nir": str(tmp_path / "four")}))
    import_files(None, capture, ImportOptions(folders={"rgb": str(tmp_path / "one")}))
    assert names(capture, "thermal") == names(capture, "nir") == []
    assert not (capture.root / "images" / "thermal").exists()


def test_same_stems_in_several_folders(tmp_path: Path, capture: CaptureFolder) -> None:
    """Files of one stem get their folder's name."""
    for folder in ("100MEDIA", "101MEDIA"):
        for number in range(3):
            write_photograph(tmp_path / "in" / folder / f"{number:04d}_V.JPG", number)
            write_values(tmp_path / "in" / folder / f"{number:04d}_T.tiff", centikelvin(number))
    import_files(tmp_path / "in", capture)
    assert names(capture, "rgb")[::3] == ["100MEDIA_0000_V.jpg", "101MEDIA_0000_V.jpg"]


def test_an_interrupted_import_goes_on(tmp_path: Path, capture: CaptureFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is there is kept; with other settings it is made again, and never taken for complete in between."""
    write_two_cameras(tmp_path / "in")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(CaptureFolder, "write_frames", killed)
        with pytest.raises(KeyboardInterrupt):
            import_files(tmp_path / "in", capture)
    assert not capture.marker("import").exists()
    kept = capture.images("thermal") / "IR_0002.png"
    written = kept.stat().st_mtime_ns
    import_files(tmp_path / "in", capture)
    assert kept.stat().st_mtime_ns == written
    import_files(tmp_path / "in", capture, ImportOptions(thermal=ThermalOptions(turn=90)))
    assert read_image(kept).shape == (48, 36)


def test_turned_and_mirrored_sensors(tmp_path: Path, capture: CaptureFolder) -> None:
    """Thermal images are turned clockwise, then mirrored."""
    write_two_cameras(tmp_path / "in")
    import_files(tmp_path / "in", capture, ImportOptions(thermal=ThermalOptions(turn=90, mirror=True)))
    expected = cv2.flip(cv2.rotate(centikelvin(2), cv2.ROTATE_90_CLOCKWISE), 1)
    assert np.array_equal(read_image(capture.images("thermal") / "IR_0002.png"), expected)


def test_exif_rotation(tmp_path: Path, capture: CaptureFolder) -> None:
    """Pixels stay as they are stored, and a sentence says so."""
    write_two_cameras(tmp_path / "in", 5)
    write_photograph(tmp_path / "in" / "visible" / "VIS_0006.jpg", 6, orientation=6)
    write_values(tmp_path / "in" / "thermal" / "IR_0006.tiff", centikelvin(6))
    assert "1 image is to be turned for display" in " ".join(import_files(tmp_path / "in", capture).sentences)
    assert capture.read_frames("rgb")[-1].orientation == 6


def refused(folder: Path, capture: CaptureFolder, pattern: str, options: ImportOptions | None = None) -> None:
    """The import is an error with these words and leaves no step complete."""
    with pytest.raises(UserError, match=pattern) as caught:
        import_files(folder, capture, options)
    assert caught.value.hint
    assert not capture.marker("import").exists()


def test_wrong_folders(tmp_path: Path, capture: CaptureFolder) -> None:
    """None, a file, an empty one, one without images, one with few photographs."""
    refused(tmp_path / "none", capture, "none does not exist")
    (tmp_path / "file").write_text("")
    refused(tmp_path / "file", capture, "is a file, not a folder")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", capture, r"No photographs and thermal files in .*Found: nothing")
    (tmp_path / "empty" / "notes.txt").write_text("")
    refused(tmp_path / "empty", capture, r"Found: notes.txt and 1 file that is no image")
    refused(write_two_cameras(tmp_path / "few", 3), capture, r"^3 usable photographs .* at least 5")


def test_our_own_folders_are_no_sources(tmp_path: Path, capture: CaptureFolder) -> None:
    """A prepared capture and a training's results."""
    other = CaptureFolder(tmp_path / "other")
    import_files(write_two_cameras(tmp_path / "in"), other)
    refused(other.root, capture, "is a capture that thermosplat-prepare made")
    (tmp_path / "run" / "ckpts").mkdir(parents=True)
    refused(tmp_path / "run", capture, "is the result folder of a training")


def test_one_spectrum_only(tmp_path: Path, capture: CaptureFolder) -> None:
    """Thermal files alone, and photographs alone."""
    write_two_cameras(tmp_path / "in")
    refused(tmp_path / "in" / "thermal", capture, "6 thermal files and no photographs")
    refused(tmp_path / "in" / "visible", capture, "6 photographs and no thermal files")


def test_several_cameras_and_sizes(tmp_path: Path, capture: CaptureFolder) -> None:
    """An error that counts them, or the most frequent; images that a program turned are said to be that."""
    write_two_cameras(tmp_path / "in")
    odd = write_photograph(tmp_path / "in" / "visible" / "VIS_0007.jpg", 7, size=(72, 96))
    refused(tmp_path / "in", capture, r"6 of 96x72 px, 1 of 72x96 px; .*VIS_0007.jpg.* turned by a program")
    write_photograph(odd, 7, size=(80, 60))
    refused(tmp_path / "in", capture, r"6 of 96x72 px, 1 of 80x60 px; .* All images of a spectrum must come from one")
    write_photograph(odd, 7, make="Maker", model="Other")
    refused(tmp_path / "in", capture, r"1 of 96x72 px \(Maker Other\)")
    import_files(tmp_path / "in", capture, ImportOptions(take_most=True))
    assert len(names(capture, "rgb")) == 6


def test_unreadable_file_in_the_middle(tmp_path: Path, capture: CaptureFolder) -> None:
    """An error that names it, or it is left out."""
    write_two_cameras(tmp_path / "in", 7)
    path = tmp_path / "in" / "visible" / "VIS_0003.jpg"
    path.write_bytes(path.read_bytes()[:-200])
    refused(tmp_path / "in", capture, r"1 of 14 images in .* cannot be read \(first: .*VIS_0003.jpg: it is cut off\)")
    changed = bytearray((tmp_path / "in" / "visible" / "VIS_0006.jpg").read_bytes())
    changed[-300:-100] = bytes(200)
    (tmp_path / "in" / "visible" / "VIS_0006.jpg").write_bytes(changed)
    thermal = tmp_path / "in" / "thermal"
    (thermal / "IR_0004.tiff").write_bytes(b"II*\0nonsense")
    cut = write_values(thermal / "IR_0005.png", centikelvin(5))
    cut.write_bytes(cut.read_bytes()[:-200])
    (thermal / "IR_0005.tiff").unlink()
    refused(
        tmp_path / "in",
        capture,
        r"4 of 14 images .* \(first: .*IR_0004.tiff: it is damaged or not an image \(\d+ bytes\)\)",
    )
    options = ImportOptions(skip_unreadable=True)
    said = " ".join(import_files(tmp_path / "in", capture, options).sentences)
    assert "4 of 14 images" in said
    assert (len(names(capture, "rgb")), len(names(capture, "thermal"))) == (5, 5)


def test_a_picture_of_wrong_pixels_is_unreadable(tmp_path: Path, capture: CaptureFolder) -> None:
    """A JPEG whose decoder fills what it lacks is refused here, and not only by the training."""
    path = write_two_cameras(tmp_path / "in", 7) / "visible" / "VIS_0002.jpg"
    content = bytearray(path.read_bytes())
    content[-300:-100] = bytes(200)
    path.write_bytes(content)
    refused(tmp_path / "in", capture, r"1 of 14 images .* cannot be read \(first: .*VIS_0002.jpg: .*Corrupt JPEG data")


def test_a_folder_of_a_third_camera_is_asked_about(tmp_path: Path, capture: CaptureFolder) -> None:
    """Grey or 16-bit images beside photographs and thermal files belong to neither without being asked for."""
    folder = write_two_cameras(tmp_path / "in")
    for number in range(1, 7):
        write_values(folder / "near_infrared" / f"{number}.png", centikelvin(number))
    refused(folder, capture, r"The folder near_infrared/ has 6 images, and nothing says .*near_infrared/1\.png")
    assert not capture.root.exists()


def test_foreign_folder_is_not_written_to(tmp_path: Path) -> None:
    """A folder with other files is refused, and nothing in it is touched."""
    write_two_cameras(tmp_path / "in")
    other = tmp_path / "other" / "images"
    other.mkdir(parents=True)
    (other / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="holds other files"):
        import_files(tmp_path / "in", CaptureFolder(tmp_path / "other"))
    assert [path.name for path in (tmp_path / "other").rglob("*")] == ["images", "mine.txt"]


def test_capture_inside_the_folder_is_no_source(tmp_path: Path) -> None:
    """Its images are not imported the next time."""
    write_two_cameras(tmp_path / "in")
    capture = CaptureFolder(tmp_path / "in" / "captures" / "one")
    import_files(tmp_path / "in", capture)
    assert import_files(tmp_path / "in", capture).before
    again = CaptureFolder(tmp_path / "in" / "captures" / "two")
    import_files(tmp_path / "in", again)
    assert len(names(again, "rgb")) == module.LEAST_PHOTOGRAPHS + 1


@pytest.mark.parametrize("count", [3, 9])
def test_pictures_that_are_not_read(tmp_path: Path, capture: CaptureFolder, count: int) -> None:
    """Some among the others are told of; where all photographs are, the error says what they are."""
    folder = write_two_cameras(tmp_path / "in", 9)
    for number in range(1, count + 1):
        path = folder / "visible" / f"VIS_{number:04d}.jpg"
        path.rename(path.with_suffix(".HEIC"))
    start = f"{count} pictures of {folder} are HEIC, which is not read (first: visible/VIS_0001.HEIC). Convert them"
    if count == 3:
        assert any(sentence.startswith(start) for sentence in import_files(folder, capture).sentences)
        return
    with pytest.raises(UserError) as caught:
        import_files(folder / "visible", capture)
    assert "9 pictures of" in caught.value.message
    assert "are HEIC, which is not read" in caught.value.message


def test_photographs_that_are_called_jfif(tmp_path: Path, capture: CaptureFolder) -> None:
    """They are JPEGs, and are called so in the capture."""
    folder = write_two_cameras(tmp_path / "in")
    for path in sorted((folder / "visible").iterdir()):
        path.rename(path.with_suffix(".jfif"))
    import_files(folder, capture)
    assert names(capture, "rgb") == [f"VIS_{number:04d}.jpg" for number in range(1, 7)]


@pytest.mark.timeout(60)
def test_what_is_no_file_is_left_alone(tmp_path: Path, capture: CaptureFolder) -> None:
    """A pipe among the images has no end, and the system's folders hold no photographs."""
    folder = write_two_cameras(tmp_path / "in")
    for name in ("visible/VIS_0007.jpg", "thermal/IR_0007.tiff", "thermal/x.mp4", "units.json"):
        os.mkfifo(folder / name)
    (folder / "proc").symlink_to("/proc")
    (folder / "visible" / "root").symlink_to("/")
    report = import_files(folder, capture)
    assert "6 RGB images of 96x72 px and 6 thermal images of 48x36 px." in report.sentences


@pytest.mark.parametrize(("filled", "tag"), [(0.005, "-9999"), (0.5, "-9999"), (0.005, None), (0.5, None)])
def test_values_that_files_call_none(tmp_path: Path, capture: CaptureFolder, filled: float, tag: str | None) -> None:
    """A few are filled from their neighbours, by GDAL's tag or a usual fill value; many are an error."""
    folder = write_two_cameras(tmp_path / "in")
    for number, path in enumerate(sorted((folder / "thermal").iterdir()), start=1):
        values = celsius(number).astype(np.float32)
        values.reshape(-1)[: int(filled * values.size)] = -9999
        path.write_bytes(tiff_file(values, tags={} if tag is None else {NODATA: tag}))
    if filled == 0.5:
        with pytest.raises(UserError, match=r"864 of 1,728 pixels without a temperature"):
            import_files(folder, capture)
        return
    report = import_files(folder, capture)
    assert "48 pixels without a temperature were filled from the neighbours." in report.sentences
    assert read_image(capture.images("thermal") / names(capture, "thermal")[0]).min() > 28_000


def test_a_fill_value_that_nobody_knows(tmp_path: Path, capture: CaptureFolder) -> None:
    """Temperatures among which many are -1000 are no counts."""
    folder = write_two_cameras(tmp_path / "in")
    for number, path in enumerate(sorted((folder / "thermal").iterdir()), start=1):
        values = celsius(number).astype(np.float32)
        values[:9] = -1000
        path.write_bytes(tiff_file(values))
    with pytest.raises(UserError, match="of the values in thermal/ are -1,000, and all others can be temperatures"):
        import_files(folder, capture)


def test_units_in_other_spellings(tmp_path: Path, capture: CaptureFolder) -> None:
    """--unit takes what units.json takes."""
    import_files(
        write_two_cameras(tmp_path / "in"), capture, ImportOptions(thermal=ThermalOptions(unit="centi-Kelvins"))
    )
    assert np.array_equal(read_image(capture.images("thermal") / names(capture, "thermal")[0]), centikelvin(1))
    with pytest.raises(UserError, match="--unit kelvn is not known"):
        ThermalOptions(unit="kelvn")


@pytest.mark.parametrize("orientation", [3, 6])
def test_turned_tiffs_keep_their_pixels(tmp_path: Path, capture: CaptureFolder, orientation: int) -> None:
    """As the sentence says that is printed of them."""
    folder = write_two_cameras(tmp_path / "in")
    for number, path in enumerate(sorted((folder / "thermal").iterdir()), start=1):
        path.write_bytes(tiff_file(centikelvin(number), tags={ORIENTATION: orientation}))
    report = import_files(folder, capture)
    assert any("pixels are used as they are stored" in sentence for sentence in report.sentences)
    for number, name in enumerate(names(capture, "thermal"), start=1):
        assert np.array_equal(read_image(capture.images("thermal") / name), centikelvin(number))
