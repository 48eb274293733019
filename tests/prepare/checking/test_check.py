"""The check of a capture: what it says of good and of bad images, and the page."""

import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from camera_folders import centikelvin, scene, write_photograph, write_two_cameras, write_values
from thermosplat.datasets.colmap.model import ColmapModel
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.lens import Lens
from thermosplat.errors import UserError
from thermosplat.prepare.capture_folder import CaptureFolder
from thermosplat.prepare.checking import check as module
from thermosplat.prepare.checking.check import PAGE, SHEET, check, estimate_of, recommend
from thermosplat.prepare.checking.findings import (
    Finding,
    count_dead_pixels,
    level_drift,
    msx_findings,
    texture_findings,
    thermal_findings,
)
from thermosplat.prepare.checking.plane_warp import PlaneWarp
from thermosplat.prepare.checking.sensor_orientation import Orientation
from thermosplat.prepare.importing.import_files import import_files
from thermosplat.prepare.pairing.pairing import pair_frames
from thermosplat.runs.atomic_writes import write_bytes

RNG = np.random.default_rng(7)
WORLD = cv2.resize(RNG.integers(0, 255, (160, 420, 3), np.uint8), (1680, 640), interpolation=cv2.INTER_CUBIC)
"""A wide textured picture, of which photographs are parts."""


def warnings(findings: list[Finding]) -> str:
    return " ".join(one.sentence for one in findings if one.level == "warning")


@pytest.fixture
def capture(tmp_path: Path) -> CaptureFolder:
    capture = CaptureFolder(tmp_path / "shed <b>")
    import_files(write_two_cameras(tmp_path / "in"), capture)
    return capture


class Pictures(HTMLParser):
    """Collects the pictures and the addresses of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]


def test_page_and_sheet(capture: CaptureFolder) -> None:
    """One page that needs no other file, names escaped, and one PNG; done once."""
    pair_frames(capture)
    report = check(capture)
    assert "6 RGB images of 96x72 px." in report.sentences
    assert "6 pairs." in report.sentences
    page = (capture.check / PAGE).read_text()
    pictures = Pictures()
    pictures.feed(page)
    assert len(pictures.sources) == 6
    assert all(source.startswith("data:image/jpeg;base64,") for source in pictures.sources)
    assert "<b>" not in page
    sheet = read_image(capture.check / SHEET)
    assert sheet.shape[1] > 3 * 320
    assert sheet.shape[0] > 6 * 200
    assert check(capture).before


def test_before_pairing(capture: CaptureFolder) -> None:
    """The check says what to do first; before an import it is an error."""
    said = " ".join(check(capture).sentences)
    assert "! No pairs yet: thermosplat-prepare pair" in said
    assert "No camera poses yet: thermosplat-prepare sfm" in said
    with pytest.raises(UserError, match="thermosplat-prepare import FOLDER"):
        check(CaptureFolder(capture.root / "none"))


def test_placed_images_are_refined(capture: CaptureFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing is paired, training corrects the poses of thermal images."""
    capture.write_pairs([])
    monkeypatch.setattr(module, "is_posed", lambda _: True)
    monkeypatch.setattr(module, "read_findings", lambda _: [])
    assert any("of another hour" in said for said in check(capture).sentences)
    assert yaml.safe_load(capture.train_yaml.read_text()) == {"refine": ["placed"]}


def test_a_folder_full_of_trouble(tmp_path: Path) -> None:
    """A closed shutter and plain photographs are named."""
    for number in range(1, 7):
        blank = number == 3
        write_values(
            tmp_path / f"IR_{number}.tiff", np.full((36, 48), 29_315, np.uint16) if blank else centikelvin(number)
        )
        write_photograph(tmp_path / f"VIS_{number}.jpg", number)
    capture = CaptureFolder(tmp_path / "out")
    import_files(tmp_path, capture)
    said = " ".join(check(capture).sentences)
    assert "1 of 6 thermal images has one value everywhere (first: IR_3.png)" in said
    assert "6 of 6 photographs have hardly any texture" in said
    assert "things will probably go wrong" in said


def test_the_estimate_counts_the_warnings() -> None:
    """It counts the warnings."""
    fact, warning = Finding("fact", ""), Finding("warning", "")
    assert "speaks against" in estimate_of([fact])
    assert estimate_of([fact, warning]).startswith("One thing")
    assert estimate_of([warning, warning]).startswith("2 things")


def test_dead_pixels_stick_out_in_nearly_all_images() -> None:
    """Only pixels that stick out in nearly all images."""
    images = [scene(number, 48, 36)[..., 1].astype(np.uint16) * 10 + 30_000 for number in range(10)]
    assert count_dead_pixels(images) == 0
    for image in images:
        image[5, 7] = 65_000
    images[3][9, 9] = 0  # once is noise
    assert count_dead_pixels(images) == 1
    findings = thermal_findings({str(number): image for number, image in enumerate(images)}, "counts")
    assert "1 thermal pixel differs" in warnings(findings)


def test_drift_of_the_level_is_told() -> None:
    """Levels that vary more than the scene are said, with the flag that helps; a steady sensor is not."""
    base = 20 + 3 * scene(1, 48, 36)[..., 0].astype(np.float32) / 255
    steady = {str(number): base + 0.01 * number for number in range(8)}
    drifting = {str(number): base + 2 * number for number in range(8)}
    assert level_drift(list(steady.values()))[0] < 0.1
    assert warnings(thermal_findings(steady, "°C")) == ""
    assert "--thermal.exposure level" in warnings(thermal_findings(drifting, "°C"))


def test_unusual_temperatures() -> None:
    """They ask whether the unit is right."""
    image = np.linspace(2000, 3000, 100, dtype=np.float32).reshape(10, 10)
    assert "Is the unit right?" in warnings(thermal_findings({"a": image}, "°C"))


def test_photographs_that_overlap_with_none_are_told() -> None:
    """Neighbours that share most of their view overlap; a photograph of another place does not."""
    walk = {f"{x}": WORLD[:, x : x + 640] for x in range(0, 1000, 120)}
    assert warnings(texture_findings(walk)) == ""
    other = cv2.resize(RNG.integers(0, 255, (160, 160, 3), np.uint8), (640, 640), interpolation=cv2.INTER_CUBIC)
    assert "1 of 10 photographs shows nothing of their neighbours' (first: elsewhere)" in warnings(
        texture_findings({**walk, "elsewhere": other})
    )


def test_photographs_without_texture_are_told() -> None:
    """A plain photograph is named."""
    walk = {f"{x}": WORLD[:, x : x + 640] for x in range(0, 600, 120)}
    findings = texture_findings({**walk, "wall": np.full((640, 640, 3), 180, np.uint8)})
    assert "1 of 6 photographs has hardly any texture (first: wall)" in warnings(findings)


def test_edges_of_the_photographs_in_thermal_pictures_are_told() -> None:
    """Thermal pictures with the photographs' edges, at another size."""
    photographs = [WORLD[:, x : x + 640] for x in range(0, 400, 100)]
    flat = np.full((320, 320, 3), 90, np.uint8)
    engraved = [
        (
            photograph,
            np.clip(flat + 0.5 * (cv2.resize(photograph, (320, 320)).astype(float) - 128), 0, 255).astype(np.uint8),
        )
        for photograph in photographs
    ]
    assert "MSX is probably on" in warnings(msx_findings(engraved))
    assert msx_findings([(photograph, flat) for photograph in photographs]) == []


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_the_turn_of_a_registered_camera(quarter: int) -> None:
    """It is what turns the images of this very camera upright."""
    upright = scene(1, 64, 64)
    turned = np.ascontiguousarray(np.rot90(upright, quarter))
    lens = Lens("PINHOLE", (60.0, 60.0, 32.0, 32.0), 64, 64)
    pose = turned_pose(quarter)
    seen = PlaneWarp(lens, lens, pose, 2.0).thermal_on_photograph(turned, 64, 64)
    assert np.abs(seen[2:-2, 2:-2].astype(int) - upright[2:-2, 2:-2]).max() <= 1
    assert 90 * module.quarters(pose) == Orientation(90 * quarter, False).turn


def turned_pose(quarter: int) -> NDArray[np.float64]:
    """A camera that stands in the same place, turned about its axis."""
    pose = np.eye(4)
    pose[:2, :2] = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarter)
    return pose


@pytest.mark.rotating
@pytest.mark.parametrize(
    ("changed", "camera", "said"),
    [
        (None, 2, ""),
        (Orientation(0, False), 0, ""),
        (
            Orientation(0, False),
            2,
            "Thermal images are turned by 180° .*, and so is the registered camera: nothing",
        ),
        (Orientation(0, False), 1, "Thermal images are turned by 90° .*, and so is the registered camera: nothing"),
        (Orientation(180, False), 0, "! Thermal images are not as they were registered, .* turned by 180°. .*register"),
        (Orientation(180, False), 2, "! Thermal images are not as they were registered, .* turned by 180°"),
        (Orientation(0, True), 0, "! Thermal images are not as they were registered, .* turned by 0° and mirrored"),
    ],
)
def test_images_are_held_against_the_registered_camera(
    capture: CaptureFolder, monkeypatch: pytest.MonkeyPatch, changed: Orientation | None, camera: int, said: str
) -> None:
    """A turned sensor is no fault if its camera is turned likewise; images that were changed afterwards are."""
    pair_frames(capture)
    lens = Lens("PINHOLE", (60.0, 60.0, 32.0, 32.0), 64, 64)
    warp = PlaneWarp(lens, lens, turned_pose(camera), 2.0)
    monkeypatch.setattr(module, "find_model", lambda _: capture.root)
    monkeypatch.setattr(
        module, "read_model", lambda folder: ColmapModel(folder, (), np.zeros((0, 3)), np.zeros((0, 3)))
    )
    monkeypatch.setattr(module, "read_warps", lambda _, names: dict.fromkeys(names, warp))
    monkeypatch.setattr(module, "orientation_as_registered", lambda *_: changed)
    found = [one for one in check(capture).sentences if "turned" in one]
    assert len(found) == bool(said)
    assert re.match(said, "".join(found))


def test_images_before_they_are_registered(capture: CaptureFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Turned and mirrored ones are a warning with the flags of the import."""
    pair_frames(capture)
    monkeypatch.setattr(module, "find_orientation", lambda _: Orientation(180, True))
    assert any(said.startswith("! ") and "again with --turn 180 --mirror" in said for said in check(capture).sentences)


def test_images_that_change_are_looked_at_again(capture: CaptureFolder) -> None:
    """A check is complete for the images that it has seen."""
    pair_frames(capture)
    check(capture)
    path = capture.images("thermal") / "IR_0003.png"
    cv2.imwrite(str(path), read_image(path)[::-1, ::-1])
    assert not check(capture).before


def test_recommendations(capture: CaptureFolder) -> None:
    """Drift asks for levels; a registered camera is precise enough, so nothing is refined unasked."""
    recommend(capture, [])
    assert not capture.train_yaml.exists()
    write_bytes(capture.marker("register"), b"{}")
    drift = Finding("warning", "", {"spectra": {"thermal": {"exposure": "level"}}})
    recommend(capture, [drift])
    settings = yaml.safe_load(capture.train_yaml.read_text())
    assert settings == {"spectra": {"thermal": {"exposure": "level"}}}
    recommend(capture, [])
    assert not capture.train_yaml.exists()
