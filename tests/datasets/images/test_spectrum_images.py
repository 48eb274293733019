"""What the files of a spectrum are taken for: pseudo-colour, grey or radiometric, with which range and values."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_folders import band8, band16, centikelvin, pseudo_color, temperatures
from thermosplat.datasets.images.capture_palette import ChosenPalette
from thermosplat.datasets.images.pixel_meaning import SpectrumFile
from thermosplat.datasets.images.spectrum_images import SpectrumReading, interpret
from thermosplat.errors import UserError
from thermosplat.spectra import THERMAL, SpectrumConfig
from thermosplat.thermal.radiometry import FLIR_IRON, Palette
from thermosplat.thermal.temperature_units import RadiometricStatement

CELSIUS = [temperatures(number) for number in range(3)]
COLOR = [SpectrumFile(Path(f"thermal/{n}.png"), pseudo_color(celsius)) for n, celsius in enumerate(CELSIUS)]
RAW = [SpectrumFile(Path(f"thermal/{n}.png"), None, centikelvin(celsius)) for n, celsius in enumerate(CELSIUS)]
BOTH = [
    SpectrumFile(color.path, color.display, raw.raw, Path("thermal_raw/x.png"))
    for color, raw in zip(COLOR, RAW, strict=True)
]
GREY = [SpectrumFile(Path(f"thermal/{n}.png"), np.full((4, 5), 51 * n, np.uint8)) for n in range(3)]
BAND8 = [SpectrumFile(Path(f"nir/{n}.png"), band8(n)) for n in range(3)]
BAND16 = [SpectrumFile(Path(f"nir/{n}.png"), None, band16(n)) for n in range(3)]
REFLECTANCE = SpectrumConfig(unit="reflectance", factor=1e-4)
UNITS = RadiometricStatement("centikelvin", (15.0, 35.0))


def thermal(**settings: Any) -> SpectrumConfig:
    return replace(THERMAL, **settings)


def read(files, config=THERMAL, *, name="thermal", palette=None, statement=None, grey=None) -> SpectrumReading:
    chosen = ChosenPalette(palette or FLIR_IRON, True)
    return interpret(
        name,
        files,
        config,
        palette=chosen,
        statement=statement or RadiometricStatement(),
        grey_range=grey,
    )


def test_pseudo_color_stays_as_it_is():
    """3-channel images are trained on; without radiometric files there are no degrees, even with a range."""
    reading = read(COLOR, thermal(range=(0.0, 50.0)))
    assert reading.scale.kind == "color"
    assert reading.scale.range == (0.0, 50.0)
    np.testing.assert_array_equal(reading.pixels[1].image, COLOR[1].display)
    assert reading.pixels[1].values is None
    assert reading.notes == ()


def test_radiometric_files_beside_pseudo_color_give_degrees():
    """Degrees come from thermal_raw/, the palette's span from units.json; the image stays the pseudo-colour one."""
    reading = read(BOTH, statement=UNITS)
    assert reading.scale.kind == "color"
    assert reading.scale.range == (15.0, 35.0)
    np.testing.assert_allclose(reading.pixels[2].values, CELSIUS[2], atol=0.006)
    intensity = reading.scale.palette.to_intensity(reading.pixels[2].image / 255)
    np.testing.assert_allclose(reading.scale.value(intensity), CELSIUS[2], atol=0.2)


def test_unknown_span_of_the_palette_is_said():
    """Degrees without a span: the user is told which flag is missing."""
    reading = read(BOTH, statement=RadiometricStatement("centikelvin"))
    assert reading.scale.range is None
    assert any("--thermal.range" in note for note in reading.notes)


def test_source_raw_trains_on_the_values():
    """--thermal.source raw normalises the temperatures by the capture's extremes."""
    reading = read(BOTH, thermal(source="raw"), statement=UNITS)
    assert reading.scale.channels == 1
    low, high = reading.scale.range
    assert low == pytest.approx(min(celsius.min() for celsius in CELSIUS), abs=0.006)
    assert high == pytest.approx(max(celsius.max() for celsius in CELSIUS), abs=0.006)
    image = reading.pixels[0].image
    assert image.dtype == np.float32
    assert image.shape == (*CELSIUS[0].shape, 1)
    np.testing.assert_allclose(reading.scale.value(image[..., 0]), CELSIUS[0], atol=0.006)
    np.testing.assert_allclose(reading.pixels[0].values, CELSIUS[0], atol=0.006)


def test_a_given_range_clips_the_image_and_not_the_truth():
    """Values beyond --thermal.range saturate in the image; the measured degrees stay."""
    reading = read(RAW, thermal(unit="centikelvin", range=(24.0, 28.0)))
    assert reading.scale.range == (24.0, 28.0)
    assert reading.pixels[0].image.min() == 0
    assert reading.pixels[0].image.max() == 1
    np.testing.assert_allclose(reading.pixels[0].values, CELSIUS[0], atol=0.006)


def test_judged_unit_is_said():
    """Radiometric files without a statement are judged by their values, and the user is told."""
    reading = read(RAW)
    assert reading.pixels[0].values is not None
    assert any("taken as centikelvin" in note and "--thermal.unit" in note for note in reading.notes)


def test_counts_are_normalised_without_degrees():
    """Sensor counts train as a scalar; there is no °C, and a dead pixel does not set the scale."""
    counts = np.random.default_rng(0).integers(4400, 4600, (64, 64)).astype(np.uint16)
    counts[1, 1] = 65535
    reading = read([SpectrumFile(Path("thermal/0.png"), None, counts)], thermal(unit="counts"))
    assert reading.scale.range is None
    assert reading.pixels[0].values is None
    assert np.median(reading.pixels[0].image) == pytest.approx(0.5, abs=0.1)
    assert reading.pixels[0].image[1, 1] == 1


def test_grey_images_with_bounds():
    """Grey level / 255 is the intensity, and with bounds a temperature (ThermoScenes)."""
    reading = read(GREY, grey=(-10.0, 41.0))
    assert reading.scale.kind == "scalar"
    assert reading.scale.range == (-10.0, 41.0)
    np.testing.assert_allclose(reading.pixels[2].image, 0.4, atol=1e-6)
    np.testing.assert_allclose(reading.pixels[2].values, -10 + 0.4 * 51, atol=1e-4)


def test_grey_images_without_bounds_have_no_degrees():
    """Nobody says what black and white are: a scalar without °C."""
    reading = read(GREY)
    assert reading.scale.range is None
    assert reading.pixels[1].values is None


def test_grey_stored_as_color_is_grey():
    """A grey JPEG with three channels is no pseudo-colour."""
    files = [SpectrumFile(file.path, np.repeat(file.display[..., None], 3, -1)) for file in GREY]
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
        read(COLOR, thermal(source="raw"))
    assert "thermal/0.png" in caught.value.message
    assert "thermal_raw/" in caught.value.hint


def test_partly_radiometric_capture_counts_what_is_missing():
    """Radiometric files for some frames only are not enough to train on, of colour or of grey images."""
    with pytest.raises(UserError, match="2 of 3 frames have no radiometric file"):
        read([BOTH[0], *COLOR[1:]], thermal(source="raw"))
    beside = replace(BAND8[0], raw=BAND16[0].raw, raw_path=Path("nir_raw/0.png"))
    for config in (REFLECTANCE, SpectrumConfig(folders=("NIR",))):
        with pytest.raises(UserError, match=r"is 8-bit grey, not values \(2 of 3 frames have no radiometric") as caught:
            read([beside, *BAND8[1:]], config, name="nir")
        assert "into nir_raw/, or train on the grey images without them: --nir.source auto" in caught.value.hint
    with pytest.raises(UserError, match=r"8-bit grey, not temperatures \(1 of 2 frames"):
        read([RAW[0], GREY[0]], thermal(source="raw", range=(0.0, 10.0)))


def test_grey_instead_of_temperature():
    """--thermal.source raw on grey images needs a range; with one it works."""
    with pytest.raises(UserError, match="8-bit grey") as caught:
        read(GREY, thermal(source="raw"))
    assert "--thermal.range" in caught.value.hint
    reading = read(GREY, thermal(source="raw", range=(0.0, 10.0)))
    np.testing.assert_allclose(reading.pixels[1].values, 2.0, atol=1e-5)


def test_color_asked_of_radiometric_files():
    """--thermal.source color on 16-bit files names what they are."""
    with pytest.raises(UserError, match="radiometric values"):
        read(RAW, thermal(source="color"))


def test_implausible_unit():
    """A stated unit in which the values are impossible is an error with the likely one."""
    with pytest.raises(UserError, match="look like centikelvin"):
        read(RAW, thermal(unit="kelvin"))
    with pytest.raises(UserError, match="look like centikelvin"):
        read(RAW, statement=RadiometricStatement("celsius"))


def test_values_that_are_no_numbers():
    """NaN in a radiometric file is named, not trained on."""
    values = np.full((4, 5), 20, np.float32)
    values[2, 2] = np.nan
    with pytest.raises(UserError, match=r"0\.tiff has 1 pixels without a value: they are not finite"):
        read([SpectrumFile(Path("thermal/0.tiff"), None, values)])


def test_an_unknown_span_of_other_values_is_said():
    """Pseudo-colours of something else than temperatures: their unit is named, not °C."""
    config = replace(REFLECTANCE, source="auto", palette="iron")
    beside = [
        replace(color, raw=band.raw, raw_path=Path("nir_raw/0.png")) for color, band in zip(COLOR, BAND16, strict=True)
    ]
    reading = read(beside, config, name="nir")
    assert (reading.scale.kind, reading.scale.unit, reading.scale.measured_unit) == ("color", "reflectance", None)
    expected = "The values of the palette's ends are unknown, so renders have no reflectance; state them with --nir."
    assert any(note.startswith(expected) for note in reading.notes)
    np.testing.assert_allclose(reading.pixels[1].values, band16(1) * 1e-4, rtol=1e-6)


@pytest.mark.parametrize("unit", ["reflectance", "counts"])
def test_8_bits_of_a_further_spectrum(unit):
    """Level / 255 is the intensity; measured is what has a unit and a range, or a unit and a factor."""
    config = SpectrumConfig(unit=unit)
    for settings, span in (
        ({}, None),
        ({"range": (0.0, 0.5)}, (0.0, 0.5)),
        ({"factor": 0.01}, (0.0, 2.55) if unit == "reflectance" else None),
        ({"factor": 0.01, "range": (0.0, 0.5)}, (0.0, 0.5)),
    ):
        reading = read(BAND8, replace(config, **settings), name="nir")
        assert reading.scale.range == (None if span is None else pytest.approx(span))
        assert reading.scale.unit == (unit if unit == "reflectance" else None)
        np.testing.assert_allclose(reading.pixels[1].image[..., 0], band8(1) / 255, atol=1e-6)
        if span is None or unit == "counts":
            assert reading.pixels[1].values is None
        else:
            np.testing.assert_allclose(reading.pixels[1].values, band8(1) / 255 * span[1], atol=1e-6)
        assert reading.notes == ()


def test_a_factor_is_that_of_the_values():
    """With 16-bit values beside 8-bit images the factor says nothing of the levels."""
    files = [replace(shown, raw=band.raw, raw_path=band.path) for shown, band in zip(BAND8, BAND16, strict=True)]
    reading = read(files, replace(REFLECTANCE, source="auto"), name="nir")
    assert reading.scale.range is None
    np.testing.assert_allclose(reading.pixels[1].values, band16(1) * 1e-4, rtol=1e-6)


def test_a_range_of_counts():
    """Stated by the user, it takes the place of the tails; what may have been temperatures has a range in °C."""
    reading = read(BAND16, SpectrumConfig(range=(0.0, 20_000.0)), name="nir")
    assert reading.scale.range == (0.0, 20_000.0)
    assert reading.scale.measured_unit is None
    assert reading.pixels[1].values is None
    np.testing.assert_allclose(reading.pixels[1].image[..., 0], band16(1) / 20_000, atol=1e-6)
    tails = read(BAND16, SpectrumConfig(), name="nir")
    assert tails.scale.range is None
    assert tails.pixels[1].image.max() == 1
    judged = read([replace(RAW[0], raw=np.full((4, 5), 4500, np.uint16))], thermal(range=(0.0, 50.0)))
    assert judged.scale.range is None


def test_photographs_in_place_of_values():
    """8-bit colour where one value per pixel is expected: both ways out are named, with the folder's own name."""
    with pytest.raises(UserError, match=r"nir/0\.png is 8-bit colour \(a palette\), not values\.") as caught:
        read([replace(COLOR[0], path=Path("nir/0.png"))], SpectrumConfig(folders=("Band5", "nir")), name="nir")
    assert "into band5_raw/" in caught.value.hint
    assert "--nir.source color" in caught.value.hint


def test_temperatures_of_another_name():
    """A spectrum is thermal by its unit, whatever it is called; flags in messages have its name."""
    reading = read(RAW, thermal(source="raw"), name="lwir")
    assert reading.scale.measured_unit == "celsius"
    assert any("--lwir.unit says otherwise" in note for note in reading.notes)
    with pytest.raises(UserError) as caught:
        read(RAW, thermal(unit="kelvin"), name="lwir")
    assert caught.value.hint == "--lwir.unit centikelvin"
    with pytest.raises(UserError, match=r"--lwir\.range must be MIN MAX"):
        read(COLOR, thermal(range=(30.0, 20.0)), name="lwir")


def test_bounds_of_temperatures_are_no_other_spectrums():
    """temperature_bounds.json says nothing of a grey image that cannot be a temperature."""
    assert read(BAND8, SpectrumConfig(unit="reflectance"), name="nir", grey=(-10.0, 41.0)).scale.range is None


def test_range_the_wrong_way_round():
    """--thermal.range must ascend."""
    with pytest.raises(UserError, match="MIN below MAX"):
        read(COLOR, thermal(range=(30.0, 20.0)))
