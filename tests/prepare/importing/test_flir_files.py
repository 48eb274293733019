"""FLIR's radiometric JPEGs: made ones, and those of RGBT-Scenes where they are at hand, beside flyr's reading."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from flir_jpeg import OFFSET, Storage, write_flir_jpeg
from thermosplat.errors import UserError
from thermosplat.prepare.importing.flir_files import is_flir, read_flir

DATA = Path(os.environ.get("THERMOSPLAT_TEST_DATA", Path(__file__).resolve().parents[4] / "shared" / "data"))
COUNTS = (11_000 + 13 * np.arange(48 * 64)).astype(np.uint16).reshape(48, 64)


@pytest.mark.parametrize("storage", ["plain", "png", "jpeg_ls"])
def test_counts_and_calibration(tmp_path: Path, storage: Storage) -> None:
    """They come back whatever way a camera compresses them."""
    image = read_flir(write_flir_jpeg(tmp_path / "a.jpg", COUNTS, storage=storage))
    assert np.array_equal(image.counts, COUNTS)
    camera = image.camera
    assert (camera.emissivity, camera.r1, camera.o) == (pytest.approx(0.95), pytest.approx(16028.2588), OFFSET)
    assert image.photograph is None


@pytest.mark.parametrize("emissivity", [0.95, 0.85])
@pytest.mark.parametrize("distance", [0.0, 60.0])
@pytest.mark.parametrize("window", [1.0, 0.9])
def test_temperatures_agree_with_flyr(tmp_path: Path, emissivity: float, distance: float, window: float) -> None:
    """To 0.05 °C, with each term of the formula in force."""
    flyr = pytest.importorskip("flyr")
    path = write_flir_jpeg(tmp_path / "a.jpg", COUNTS, camera={0x20: emissivity, 0x24: distance, 0x34: window})
    theirs = flyr.unpack(str(path)).celsius
    assert np.abs(read_flir(path).celsius - theirs).max() < 0.05
    assert np.ptp(theirs) > 50


def test_real_files_agree_with_flyr() -> None:
    """Temperatures of the FLIR files of RGBT-Scenes, those that flyr can read."""
    flyr = pytest.importorskip("flyr")
    files = [path for path in sorted((DATA / "rgbt_scenes_samples").glob("*.jpg")) if is_flir(path.read_bytes())]
    if not files:
        pytest.skip("no rgbt_scenes_samples in the shared data folder (THERMOSPLAT_TEST_DATA)")
    compared = 0
    for path in files:
        ours = read_flir(path).celsius
        assert np.isfinite(ours).all()
        assert -40 < ours.min() < ours.max() < 600
        try:
            theirs = flyr.unpack(str(path)).celsius
        except ValueError:  # flyr knows no JPEG-LS
            continue
        assert np.abs(ours - theirs).max() < 0.05
        compared += 1
    assert compared >= 10


@pytest.mark.parametrize("storage", ["plain", "png"])
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("counts_order", "<>")
def test_byte_orders(tmp_path: Path, storage: Storage, order: str, counts_order: str) -> None:
    """The counts themselves tell their order, whatever the record's is; where they are equal, the record does."""
    kinds = {"storage": storage, "order": order, "counts_order": counts_order}
    assert np.array_equal(read_flir(write_flir_jpeg(tmp_path / "a.jpg", COUNTS, **kinds)).counts, COUNTS)
    noise = (12_000 + np.random.default_rng(0).integers(0, 300, (48, 64))).astype(np.uint16)
    assert np.array_equal(read_flir(write_flir_jpeg(tmp_path / "a.jpg", noise, **kinds)).counts, noise)
    if order == counts_order:
        plain = np.full((48, 64), 12_345, np.uint16)
        assert np.array_equal(read_flir(write_flir_jpeg(tmp_path / "a.jpg", plain, **kinds)).counts, plain)


def test_a_real_camera_of_the_other_byte_order() -> None:
    """The ThermaCAM EX320 beside FLIR Tools' numbers: 19.80, 27.70 and 37.14 °C."""
    path = DATA.parent / "cases" / "20-flir-ex320" / "BillHotFlashThermography.jpg"
    if not path.is_file():
        pytest.skip("no cases/20-flir-ex320 beside the shared data folder (THERMOSPLAT_TEST_DATA)")
    celsius = read_flir(path).celsius
    assert (celsius.min(), celsius.mean(), celsius.max()) == pytest.approx((19.80, 27.70, 37.14), abs=0.06)


@pytest.mark.parametrize(
    ("name", "middle"), [("DJI_XT2", 34), ("DJI_XTR", 26), ("FLIR_AX8", 25.1), ("FLIR_B60", -7.2), ("FLIR_E40", 20.9)]
)
def test_real_files_agree_with_what_they_show(name: str, middle: float) -> None:
    """The middle's temperature as it stands in the picture or in XMP, read by eye; AX8: the mean."""
    path = DATA / "real_files" / f"{name}.jpg"
    if not path.is_file():
        pytest.skip("no real_files in the shared data folder (THERMOSPLAT_TEST_DATA)")
    celsius = read_flir(path).celsius
    height, width = celsius.shape
    seen = (
        celsius if name == "FLIR_AX8" else celsius[height // 2 - 1 : height // 2 + 1, width // 2 - 1 : width // 2 + 1]
    )
    assert np.mean(seen) == pytest.approx(middle, abs=0.6)


def test_what_a_camera_can_measure(tmp_path: Path) -> None:
    """As the file states it, and without end where it states nonsense."""
    assert read_flir(write_flir_jpeg(tmp_path / "a.jpg", COUNTS, camera={0x98: 423.15, 0x9C: 233.15})).span == (
        pytest.approx(-40, abs=0.01),
        pytest.approx(150, abs=0.01),
    )
    for nonsense in ({}, {0x98: 200.0, 0x9C: 300.0}, {0x98: float("nan"), 0x9C: 0.0}, {0x98: float("inf")}):
        span = read_flir(write_flir_jpeg(tmp_path / "a.jpg", COUNTS, camera=nonsense)).span
        assert span == (-np.inf, np.inf)


def test_the_photograph_inside_a_flir_file(tmp_path: Path) -> None:
    """The embedded photograph comes out as the camera compressed it."""
    photograph = np.full((60, 80, 3), (200, 100, 50), np.uint8)
    content = read_flir(write_flir_jpeg(tmp_path / "a.jpg", COUNTS, photograph=photograph)).photograph
    assert content is not None
    decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - photograph).max() < 6


def test_what_is_flir(tmp_path: Path) -> None:
    """A plain JPEG and the empty file are not; a radiometric one is."""
    plain = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    assert not is_flir(plain)
    assert not is_flir(b"")
    assert is_flir(write_flir_jpeg(tmp_path / "a.jpg", COUNTS).read_bytes())


def test_damaged_files(tmp_path: Path) -> None:
    """Counts that are cut off, an impossible calibration, a file without counts: an error that names the file."""
    path = write_flir_jpeg(tmp_path / "short.jpg", COUNTS)
    content = path.read_bytes()
    at = content.index(COUNTS[0].astype("<u2").tobytes()) - 0x20
    path.write_bytes(content[: at + 2] + b"\xff\x7f" + content[at + 4 :])  # a width of 32,767 px
    with pytest.raises(UserError, match=r"radiometric data in .*short.jpg is damaged"):
        read_flir(path)
    path = write_flir_jpeg(tmp_path / "bomb.jpg", COUNTS, storage="png")
    content = path.read_bytes()
    at = content.index(b"\x89PNG") + 16
    path.write_bytes(content[:at] + b"\0\0\xff\xff\0\0\xff\xff" + content[at + 8 :])  # a PNG of 4 gigapixels
    with pytest.raises(UserError, match=r"bomb.jpg is damaged: its image is not one of 64x48 px"):
        read_flir(path)
    with pytest.raises(UserError, match=r"dark.jpg: The radiometric calibration is impossible: emissivity"):
        read_flir(write_flir_jpeg(tmp_path / "dark.jpg", COUNTS, camera={0x20: 0.0}))
    (tmp_path / "plain.jpg").write_bytes(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    with pytest.raises(UserError, match=r"plain.jpg is damaged"):
        read_flir(tmp_path / "plain.jpg")
