"""What thermal files are taken for: pseudo-colour, grey or radiometric, with which range and degrees."""

from pathlib import Path

import numpy as np
import pytest
from capture_folders import centikelvin, pseudo_color, temperatures

from thermosplat.config import ThermalConfig
from thermosplat.datasets.capture_palette import ChosenPalette
from thermosplat.datasets.temperature_units import RadiometricStatement
from thermosplat.datasets.thermal_images import ThermalFile, ThermalReading, interpret
from thermosplat.errors import UserError
from thermosplat.radiometry import FLIR_IRON, Palette

CELSIUS = [temperatures(number) for number in range(3)]
COLOR = [ThermalFile(Path(f"thermal/{n}.png"), pseudo_color(celsius)) for n, celsius in enumerate(CELSIUS)]
RAW = [ThermalFile(Path(f"thermal/{n}.png"), None, centikelvin(celsius)) for n, celsius in enumerate(CELSIUS)]
BOTH = [
    ThermalFile(color.path, color.display, raw.raw, Path("thermal_raw/x.png"))
    for color, raw in zip(COLOR, RAW, strict=True)
]
GREY = [ThermalFile(Path(f"thermal/{n}.png"), np.full((4, 5), 51 * n, np.uint8)) for n in range(3)]
UNITS = RadiometricStatement("centikelvin", (15.0, 35.0))


def read(files, config=None, *, palette=None, statement=None, grey=None) -> ThermalReading:
    chosen = ChosenPalette(palette or FLIR_IRON, True)
    return interpret(
        files,
        config or ThermalConfig(),
        palette=chosen,
        statement=statement or RadiometricStatement(),
        grey_range=grey,
    )


def test_pseudo_color_stays_as_it_is():
    """3-channel images are trained on; without radiometric files there are no degrees, even with a range."""
    reading = read(COLOR, ThermalConfig(range_celsius=(0.0, 50.0)))
    assert reading.scale.kind == "color"
    assert reading.scale.range_celsius == (0.0, 50.0)
    np.testing.assert_array_equal(reading.pixels[1].image, COLOR[1].display)
    assert reading.pixels[1].celsius is None
    assert reading.notes == ()


def test_radiometric_files_beside_pseudo_color_give_degrees():
    """Degrees come from thermal_raw/, the palette's span from units.json; the image stays the pseudo-colour one."""
    reading = read(BOTH, statement=UNITS)
    assert reading.scale.kind == "color"
    assert reading.scale.range_celsius == (15.0, 35.0)
    np.testing.assert_allclose(reading.pixels[2].celsius, CELSIUS[2], atol=0.006)
    intensity = reading.scale.palette.to_intensity(reading.pixels[2].image / 255)
    np.testing.assert_allclose(reading.scale.celsius(intensity), CELSIUS[2], atol=0.2)


def test_unknown_span_of_the_palette_is_said():
    """Degrees without a span: the user is told which flag is missing."""
    reading = read(BOTH, statement=RadiometricStatement("centikelvin"))
    assert reading.scale.range_celsius is None
    assert any("--thermal.range-celsius" in note for note in reading.notes)


def test_source_raw_trains_on_the_values():
    """--thermal.source raw normalises the temperatures by the capture's extremes."""
    reading = read(BOTH, ThermalConfig(source="raw"), statement=UNITS)
    assert reading.scale.channels == 1
    low, high = reading.scale.range_celsius
    assert low == pytest.approx(min(celsius.min() for celsius in CELSIUS), abs=0.006)
    assert high == pytest.approx(max(celsius.max() for celsius in CELSIUS), abs=0.006)
    image = reading.pixels[0].image
    assert image.dtype == np.float32
    assert image.shape == (*CELSIUS[0].shape, 1)
    np.testing.assert_allclose(reading.scale.celsius(image[..., 0]), CELSIUS[0], atol=0.006)
    np.testing.assert_allclose(reading.pixels[0].celsius, CELSIUS[0], atol=0.006)


def test_a_given_range_clips_the_image_and_not_the_truth():
    """Values beyond --thermal.range-celsius saturate in the image; the measured degrees stay."""
    reading = read(RAW, ThermalConfig(unit="centikelvin", range_celsius=(24.0, 28.0)))
    assert reading.scale.range_celsius == (24.0, 28.0)
    assert reading.pixels[0].image.min() == 0
    assert reading.pixels[0].image.max() == 1
    np.testing.assert_allclose(reading.pixels[0].celsius, CELSIUS[0], atol=0.006)


def test_judged_unit_is_said():
    """Radiometric files without a statement are judged by their values, and the user is told."""
    reading = read(RAW)
    assert reading.pixels[0].celsius is not None
    assert any("taken as centikelvin" in note and "--thermal.unit" in note for note in reading.notes)


def test_counts_are_normalised_without_degrees():
    """Sensor counts train as a scalar; there is no °C, and a dead pixel does not set the scale."""
    counts = np.random.default_rng(0).integers(4400, 4600, (64, 64)).astype(np.uint16)
    counts[1, 1] = 65535
    reading = read([ThermalFile(Path("thermal/0.png"), None, counts)], ThermalConfig(unit="counts"))
    assert reading.scale.range_celsius is None
    assert reading.pixels[0].celsius is None
    assert np.median(reading.pixels[0].image) == pytest.approx(0.5, abs=0.1)
    assert reading.pixels[0].image[1, 1] == 1


def test_grey_images_with_bounds():
    """Grey level / 255 is the intensity, and with bounds a temperature (ThermoScenes)."""
    reading = read(GREY, grey=(-10.0, 41.0))
    assert reading.scale.kind == "scalar"
    assert reading.scale.range_celsius == (-10.0, 41.0)
    np.testing.assert_allclose(reading.pixels[2].image, 0.4, atol=1e-6)
    np.testing.assert_allclose(reading.pixels[2].celsius, -10 + 0.4 * 51, atol=1e-4)


def test_grey_images_without_bounds_have_no_degrees():
    """Nobody says what black and white are: a scalar without °C."""
    reading = read(GREY)
    assert reading.scale.range_celsius is None
    assert reading.pixels[1].celsius is None


def test_grey_stored_as_color_is_grey():
    """A grey JPEG with three channels is no pseudo-colour."""
    files = [ThermalFile(file.path, np.repeat(file.display[..., None], 3, -1)) for file in GREY]
    reading = read(files)
    assert reading.scale.channels == 1
    np.testing.assert_allclose(reading.pixels[2].image, 0.4, atol=1e-6)


def test_another_palette_is_said():
    """Images far off the palette get a note with the flag that mends it."""
    green = Palette(np.array([[0, 0, 0], [0, 1, 0]], np.float32))
    notes = read(COLOR, palette=green).notes
    assert any("off the palette" in note and "--thermal.palette" in note for note in notes)


def test_palette_instead_of_temperature():
    """--thermal.source raw on pseudo-colour alone is an error that says what is missing."""
    with pytest.raises(UserError, match="8-bit colour") as caught:
        read(COLOR, ThermalConfig(source="raw"))
    assert "thermal/0.png" in caught.value.message
    assert "thermal_raw/" in caught.value.hint


def test_partly_radiometric_capture_counts_what_is_missing():
    """Radiometric files for some frames only are not enough to train on."""
    with pytest.raises(UserError, match="2 of 3 frames have no radiometric file"):
        read([BOTH[0], *COLOR[1:]], ThermalConfig(source="raw"))


def test_grey_instead_of_temperature():
    """--thermal.source raw on grey images needs a range; with one it works."""
    with pytest.raises(UserError, match="8-bit grey") as caught:
        read(GREY, ThermalConfig(source="raw"))
    assert "--thermal.range-celsius" in caught.value.hint
    reading = read(GREY, ThermalConfig(source="raw", range_celsius=(0.0, 10.0)))
    np.testing.assert_allclose(reading.pixels[1].celsius, 2.0, atol=1e-5)


def test_color_asked_of_radiometric_files():
    """--thermal.source color on 16-bit files names what they are."""
    with pytest.raises(UserError, match="radiometric values"):
        read(RAW, ThermalConfig(source="color"))


def test_implausible_unit():
    """A stated unit in which the values are impossible is an error with the likely one."""
    with pytest.raises(UserError, match="look like centikelvin"):
        read(RAW, ThermalConfig(unit="kelvin"))
    with pytest.raises(UserError, match="look like centikelvin"):
        read(RAW, statement=RadiometricStatement("celsius"))


def test_values_that_are_no_numbers():
    """NaN in a radiometric file is named, not trained on."""
    values = np.full((4, 5), 20, np.float32)
    values[2, 2] = np.nan
    with pytest.raises(UserError, match="1 pixels that are not finite"):
        read([ThermalFile(Path("thermal/0.tiff"), None, values)])


def test_range_the_wrong_way_round():
    """--thermal.range-celsius must ascend."""
    with pytest.raises(UserError, match="MIN below MAX"):
        read(COLOR, ThermalConfig(range_celsius=(30.0, 20.0)))
