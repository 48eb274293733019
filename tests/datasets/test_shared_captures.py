"""Real and rendered captures of the shared data folder; skipped where there is none."""

import os
from pathlib import Path

import numpy as np
import pytest

from capture_folders import spectra_with
from thermosplat.datasets import load_capture
from thermosplat.datasets.images.flir_metadata import read_flir_palette
from thermosplat.datasets.images.image_files import read_image
from thermosplat.datasets.images.msx import edge_correlation
from thermosplat.thermal.radiometry import FLIR_IRON, load_palette

DATA = Path(os.environ.get("THERMOSPLAT_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def shared(name: str) -> Path:
    if not (DATA / name).exists():
        pytest.skip(f"no {name} in the shared data folder (THERMOSPLAT_TEST_DATA)")
    return DATA / name


@pytest.mark.parametrize(("name", "span"), [("desk", (20.0, 41.5)), ("lab", (19.5, 59.5)), ("yard", (-3.5, 59.0))])
def test_rendered_captures(name, span):
    """Flat thermal_raw/ of centikelvin TIFFs beside pseudo-colour; the palette's inverse gives the degrees back."""
    capture = load_capture(shared(f"rgbt_synthetic/{name}"), data_factor=2)
    assert (len(capture.train), len(capture.test)) == (42, 6)
    assert capture.notes == ()
    assert capture.scales["thermal"].range == span
    view = capture.test[0].views["thermal"]
    shown = capture.scales["thermal"].value(capture.scales["thermal"].palette.to_intensity(view.image / 255))
    assert np.abs(shown - np.clip(view.values, *span)).mean() < 0.02 * (span[1] - span[0])


def test_real_capture_of_counts():
    """Arco castle: FLIR Iron without °C, radiometric counts on demand."""
    root = shared("arco_castle_rgbt/scene_640x480")
    capture = load_capture(root, data_factor=8)
    assert (len(capture.train), len(capture.test)) == (35, 5)
    assert len(capture.points) == 31172
    assert capture.scales["thermal"].range is None
    assert all(frame.aligned and frame.views["thermal"].values is None for frame in capture.train)
    raw = load_capture(root, data_factor=8, spectra=spectra_with(thermal={"source": "raw"}))
    assert raw.scales["thermal"].kind == "scalar"
    values = np.stack([frame.views["thermal"].image for frame in raw.train])
    assert ((values == 0) | (values == 1)).mean() < 0.01
    assert values.std() > 0.03


def test_workswell_tiff():
    """The vendor's untouched TIFFs are read."""
    pytest.importorskip("PIL")
    path = sorted(shared("arco_castle_rgbt/original").glob("RadTIFF/*.tiff"))[0]
    image = read_image(path)
    assert image.shape == (512, 640)
    assert image.dtype == np.uint16


def test_real_thermoscenes_frames():
    """One train and one eval frame with bounds and distortion."""
    capture = load_capture(shared("thermoscenes_mock"))
    assert [len(capture.train), len(capture.test)] == [1, 1]
    assert capture.scales["thermal"].range == pytest.approx((-15.6815, 15.5584), abs=1e-3)
    assert capture.train[0].aligned
    assert capture.train[0].views["rgb"].camera.fy > 1.5 * capture.train[0].views["rgb"].camera.fx


def test_real_flir_palette():
    """The palette in RGBT-Scenes files is the decoded one, fits the pixels, and is close to the built-in stops."""
    samples = shared("rgbt_scenes_samples")
    stored = read_flir_palette(samples / "dimsum_thermal.jpg")
    decoded = load_palette(shared("flir_iron_palette/iron_rgb_224.csv"), "thermal")
    np.testing.assert_allclose(stored.colors, decoded.colors, atol=1 / 255)
    pixels = read_image(samples / "dimsum_thermal.jpg") / np.float32(255)
    assert stored.residual(pixels) < 4
    assert np.abs(stored.to_intensity(pixels) - FLIR_IRON.to_intensity(pixels)).mean() < 0.01


def test_real_msx_images_are_told_from_thermal_ones():
    """On RGBT-Scenes pairs of one size, MSX exports correlate with visible edges and thermal ones do not."""
    samples = shared("rgbt_scenes_samples")
    for name in ("Parterre", "landscape", "roadblock", "Dark"):
        rgb, thermal, msx = (read_image(samples / f"{name}_{kind}.jpg") for kind in ("rgb", "thermal", "msx"))
        assert abs(edge_correlation(rgb, thermal)) < 0.3
        assert abs(edge_correlation(rgb, msx)) > 0.3
