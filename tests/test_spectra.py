"""What spectra say of a model: channels, latent channels, opacities, modulation, and how they are called."""

from collections.abc import Mapping
from dataclasses import replace

import pytest

from thermosplat.spectra import (
    DEFAULT_SPECTRA,
    RGB,
    THERMAL,
    ColorSpace,
    Spectrum,
    SpectrumConfig,
    folder_names,
    label,
    latent_channels,
    listed,
    model_spectra,
    unit_label,
    unit_named,
)

NIR = SpectrumConfig()
SPACES: dict[str, ColorSpace] = {"rgb": "photograph", "thermal": "color", "nir": "scalar", "uv": "scalar"}


def modelled(**spectra: SpectrumConfig) -> dict[str, Spectrum]:
    return {spectrum.name: spectrum for spectrum in model_spectra(spectra, SPACES)}


def test_thermosplats_spectra() -> None:
    """The defaults: RGB modulated by the thermal prior, whose opacity is an offset; channels 0 to 2, and 3."""
    rgb, thermal = model_spectra(DEFAULT_SPECTRA, SPACES)
    assert rgb == Spectrum("rgb", 3, "photograph", "shared", (0, 3), "thermal")
    assert thermal == Spectrum("thermal", 3, "color", "offset", (3, 4), None)
    assert rgb.is_photograph
    assert not thermal.is_photograph


def test_images_of_values_have_one_channel() -> None:
    """Photographs and pseudo-colours three, as the capture has them."""
    assert {name: s.channels for name, s in modelled(rgb=RGB, thermal=THERMAL, nir=NIR).items()} == {
        "rgb": 3,
        "thermal": 3,
        "nir": 1,
    }
    (thermal,) = model_spectra({"thermal": THERMAL}, {"thermal": "scalar"})
    assert thermal.channels == 1


@pytest.mark.parametrize(
    ("spectra", "expected"),
    [
        ({"rgb": RGB, "thermal": THERMAL, "nir": NIR}, {"rgb": (0, 3), "thermal": (3, 4), "nir": (4, 5)}),
        ({"thermal": THERMAL}, {"thermal": (0, 1)}),
        ({"nir": NIR, "rgb": RGB}, {"nir": (0, 1), "rgb": (1, 4)}),
        (
            {"rgb": RGB, "nir": replace(NIR, features=None), "thermal": THERMAL},
            {"rgb": (0, 3), "nir": (3, 3), "thermal": (3, 4)},
        ),
        ({"rgb": RGB, "nir": replace(NIR, features=0.0)}, {"rgb": (0, 3), "nir": (3, 4)}),
        ({"zoom": SpectrumConfig(source="photograph"), "rgb": RGB}, {"zoom": (0, 3), "rgb": (3, 6)}),
    ],
)
def test_latent_channels(spectra: Mapping[str, SpectrumConfig], expected: dict[str, tuple[int, int]]) -> None:
    """Three per photograph, one per scalar, in order; none without features, while a weight of 0 keeps its channel."""
    assert latent_channels(spectra) == expected


def test_the_first_spectrum_has_the_opacity_itself() -> None:
    """Whatever it asks for; the others have what they ask for."""
    own = replace(NIR, opacity="own")
    assert [s.opacity for s in modelled(thermal=THERMAL, rgb=RGB, nir=own).values()] == ["shared", "shared", "own"]
    assert [s.opacity for s in modelled(nir=own, thermal=THERMAL).values()] == ["shared", "offset"]


def test_modulation_by_the_spectrum_that_is_asked_for() -> None:
    """A further spectrum has a prior of its own unless it says otherwise."""
    three = modelled(rgb=RGB, thermal=THERMAL, nir=NIR)
    assert {name: s.modulated_by for name, s in three.items()} == {"rgb": "thermal", "thermal": None, "nir": None}
    assert modelled(rgb=RGB, thermal=THERMAL, nir=replace(NIR, modulated_by="rgb"))["nir"].modulated_by == "rgb"


def test_modulation_without_that_spectrum() -> None:
    """The first other one with a prior of its own takes its place; alone, a spectrum keeps a prior of that name."""
    assert modelled(rgb=RGB, nir=NIR)["rgb"].modulated_by == "nir"
    follower = replace(NIR, modulated_by="rgb")
    assert modelled(rgb=RGB, nir=follower, uv=NIR)["rgb"].modulated_by == "uv"
    assert modelled(rgb=RGB)["rgb"].modulated_by == "thermal"


def test_folders_of_a_spectrum() -> None:
    """The stated names in lower case, else the spectrum's own."""
    assert folder_names("thermal", THERMAL)[0] == "thermal"
    assert folder_names("rgb", RGB)[0] == "rgb"
    assert folder_names("nir", NIR) == ("nir",)
    assert folder_names("nir", replace(NIR, folders=("Band5", "NIR"))) == ("band5", "nir")


@pytest.mark.parametrize(
    ("name", "expected"),
    [("rgb", "RGB"), ("nir", "NIR"), ("uv", "UV"), ("thermal", "thermal"), ("red_edge", "red edge"), ("swir", "swir")],
)
def test_labels_of_spectra(name: str, expected: str) -> None:
    """Abbreviations of up to three letters are written in capitals, other names as words."""
    assert label(name) == expected


def test_lists_of_labels() -> None:
    """As a sentence has them."""
    assert listed(["rgb"]) == "RGB"
    assert listed(["rgb", "thermal"]) == "RGB and thermal"
    assert listed(["rgb", "nir", "red_edge"]) == "RGB, NIR and red edge"


def test_units_for_people() -> None:
    """Temperatures have a sign; other units are their name."""
    assert (unit_label("celsius"), unit_label("reflectance")) == ("°C", "reflectance")


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("kelvin", ["Kelvin", "K", "kelvins", " degK ", "°K", "deg K"]),
        ("centikelvin", ["centikelvins", "Centi-Kelvin", "centi_kelvin", "cK", "centiK"]),
        ("decikelvin", ["decikelvin", "dK"]),
        ("millikelvin", ["mK", "milli kelvin"]),
        ("celsius", ["Celsius", "C", "°C", "degC", "deg_C", "℃", "degrees Celsius", "Centigrade", "º C"]),
        ("centicelsius", ["centi-degrees C", "centidegC", "centicelsius"]),
        ("fahrenheit", ["F", "°F", "degF", "Fahrenheit", "℉"]),
        ("counts", ["counts", "Count", "DN", "ADU", "digital numbers"]),
        ("auto", ["auto", "Auto"]),
        ("reflectance", ["reflectance"]),
        ("W/m2", ["W/m2"]),
    ],
)
def test_units_in_any_usual_spelling(unit: str, words: list[str]) -> None:
    """A spectrum has the unit by its own name, however it was written; another word is a unit of the user's own."""
    assert [unit_named(word) for word in words] == [unit] * len(words)
    assert SpectrumConfig(unit=words[0]).unit == unit
