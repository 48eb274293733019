"""Lists of spectra that no run can work with."""

import re
from dataclasses import replace
from typing import Any

import pytest
from torch import nn

from thermosplat.config import TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.config.files import load_config
from thermosplat.config.spectrum_checks import RESERVED
from thermosplat.errors import UserError
from toy_scene import with_spectra


def refused(config: TrainConfig, *, source: str = "") -> UserError:
    with pytest.raises(UserError) as caught:
        check_config(config, source=source)
    return caught.value


@pytest.mark.parametrize(
    "name",
    [
        *("NIR", "near infrared", "near-infrared", "1550nm", "_nir", "", "nir/left", "grün"),
        *("features", "shared", "train", "points", "pixels", "num_gaussians", "loss", "data", "seed", "without"),
    ],
)
def test_names_that_files_and_flags_cannot_have(name: str) -> None:
    """Other signs than small letters, digits and underscores, and what something else is called."""
    error = refused(with_spectra(TrainConfig(), **{name: {}}))
    assert error.message == f'--spectra: "{name}" cannot be the name of a spectrum.'
    assert "small letters, digits and underscores" in error.hint


def test_names_that_torchs_modules_cannot_have() -> None:
    """Networks of a spectrum lie in a ModuleDict under its name, where methods have names, too."""
    for modules in (nn.ModuleDict(), nn.ParameterDict()):
        assert {name for name in dir(modules) if re.fullmatch("[a-z][a-z0-9_]*", name)} <= RESERVED


@pytest.mark.parametrize("name", ["nir", "red_edge", "swir2", "uv", "band5"])
def test_names_that_they_can_have(name: str) -> None:
    """A further spectrum with nothing but its defaults."""
    check_config(with_spectra(TrainConfig(), **{name: {}}))


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"source": "labels"}, "between 2 and 255 different names where source is labels, found 0: none"),
        ({"source": "labels", "classes": ("a",)}, "between 2 and 255 .*, found 1: a"),
        ({"source": "labels", "classes": ("a", "b", "a")}, "between 2 and 255 .*, found 3: a, b, a"),
        ({"source": "labels", "classes": ("a", " ")}, "between 2 and 255 .*, found 2: a,  "),
        ({"source": "labels", "classes": tuple(map(str, range(256)))}, "between 2 and 255 .*, found 256: 0, 1"),
        ({"classes": ("a", "b")}, "none where source is raw, found 2: a, b"),
    ],
)
def test_labels_have_names_for_their_classes(settings: dict[str, Any], found: str) -> None:
    """As many as an 8-bit image can tell apart, each once; nothing else has classes."""
    error = refused(with_spectra(TrainConfig(), parts=settings))
    assert re.match(f"--parts.classes must be {found}", error.message)
    assert "classes: [background, window, door]" in error.hint


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"source": "bands"}, "--parts.channels must be 1 to 4,096 where source is bands, found 0"),
        ({"source": "features", "channels": 4097}, "--parts.channels must be at most 4,096, found 4,097"),
        ({"channels": 3}, "--parts.channels must be 0 where source is raw, found 3"),
        ({"source": "features", "channels": 3, "derived": ("x = b1",)}, "--parts.derived are layers of bands"),
        ({"source": "bands", "channels": 3, "derived": ("x = b4",)}, "--parts.derived: 'x = b4' has 'b4'"),
        ({"source": "bands", "channels": 3, "derived": ("x = b1", "x = b2")}, "--parts.derived gives two layers one"),
        ({"source": "bands", "channels": 3, "smoothness": 0.1}, "--parts.smoothness is of images that a camera took"),
        ({"source": "labels", "classes": ("a", "b"), "exposure": "affine"}, "--parts.exposure is of images"),
    ],
)
def test_stacks_have_channels(settings: dict[str, Any], found: str) -> None:
    """Nothing else has; formulas are of bands that exist; settings of cameras are refused."""
    assert refused(with_spectra(TrainConfig(), parts=settings)).message.startswith(found)


def test_a_spectrum_that_is_left_out_exists() -> None:
    """A typo gets a suggestion and the names that there are."""
    error = refused(replace(TrainConfig(), without=("termal",)))
    assert error.message == '--without: there is no spectrum "termal" (did you mean "thermal"?).'
    assert error.hint == "The spectra are rgb, thermal."


def test_nothing_to_train() -> None:
    """A model of no spectrum is refused."""
    error = refused(replace(TrainConfig(), without=("rgb", "thermal")))
    assert error.message == "--without leaves out all spectra: there is nothing to train."


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"loss": -1.0}, "--nir.loss must be zero or positive, found -1.0."),
        ({"features": -0.5}, "--nir.features must be zero or positive, found -0.5."),
        ({"smoothness": -0.1}, "--nir.smoothness must be zero or positive"),
        ({"squared": -0.1}, "--nir.squared must be zero or positive"),
        ({"squared": -1.0}, "--nir.squared must be zero or positive"),
        ({"loss": float("nan")}, "--nir.loss must be finite, found nan."),
        ({"train_from": 1.5}, "--nir.train-from must lie between 0 and 1, found 1.5."),
        ({"train_until": -0.5}, "--nir.train-until must lie between 0 and 1"),
        ({"train_from": 0.6, "train_until": 0.6}, "--nir.train-from 0.6 must be below --nir.train-until 0.6: no step"),
        ({"factor": 0.0}, "--nir.factor must be positive, found 0.0."),
        ({"factor": -1.0}, "--nir.factor must be positive"),
        ({"range": (1.0, 1.0)}, "--nir.range must rise from the lowest to the highest value, found 1.0 to 1.0."),
        ({"range": (0.0, float("inf"))}, "--nir.range must be finite, found inf."),
        ({"unit": "W per m2"}, "--nir.unit must be one word, found 'W per m2'."),
        ({"unit": ""}, "--nir.unit must be one word"),
        ({"unit": "celcius"}, '--nir.unit: celcius is no unit that is known (did you mean "celsius"?).'),
        ({"unit": "kelvin100"}, '--nir.unit: kelvin100 is no unit that is known (did you mean "kelvin"?).'),
        ({"unit": "Temperature"}, "--nir.unit: Temperature is no unit that is known."),
        ({"folders": ("nir", "../other")}, "--nir.folders must be names of folders inside the capture"),
        ({"folders": ("",)}, "--nir.folders must be names of folders inside the capture, found ''."),
        ({"folders": ("a\\b",)}, "--nir.folders must be names of folders inside the capture"),
        ({"modulated_by": "nir"}, "--nir.modulated-by must be another spectrum, found 'nir'."),
        ({"modulated_by": "termal"}, "found 'termal' (did you mean \"thermal\"?)."),
        ({"start": "point"}, "--nir.start must be another spectrum, found 'point' (did you mean \"points\"?)."),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], expected: str) -> None:
    """Each by the spectrum's own flag."""
    assert expected in refused(with_spectra(TrainConfig(), nir=settings)).message


def test_settings_of_a_file_are_named_as_there() -> None:
    """The file and the whole key."""
    error = refused(with_spectra(TrainConfig(), nir={"factor": 0.0}), source="my.yaml")
    assert error.message == "my.yaml: spectra.nir.factor must be positive, found 0.0."


@pytest.mark.parametrize(
    ("name", "settings", "folder", "owner"),
    [
        ("ir", {}, "ir", "thermal"),
        ("nir", {"folders": ("nir", "VIS")}, "vis", "RGB"),
        ("nir", {"folders": ("thermal_raw",)}, "thermal_raw", "thermal"),
        ("thermal_raw", {}, "thermal_raw", "thermal"),
    ],
)
def test_folders_of_two_spectra(name: str, settings: dict[str, Any], folder: str, owner: str) -> None:
    """Images would be read twice, as something else each time."""
    error = refused(with_spectra(TrainConfig(), **{name: settings}))
    assert error.message.startswith(f"{folder}/ would hold images of {owner} and of ")
    assert f"--{name.replace('_', '-')}.folders" in error.hint


def test_schedule_must_leave_something_to_train() -> None:
    """A gap between the spectra, or one before or after them, is refused; spectra that overlap are fine."""
    gap = with_spectra(TrainConfig(), rgb={"train_until": 0.3}, thermal={"train_from": 0.6})
    error = refused(gap)
    assert error.message == (
        "--rgb.train-until and --thermal.train-from leave a gap: after 0.3 of the steps there is nothing to train on."
    )
    check_config(with_spectra(gap, nir={"train_from": 0.2, "train_until": 0.7}))
    assert "after 0.7" in refused(with_spectra(gap, nir={"train_until": 0.7}, thermal={"train_from": 0.8})).message
    late = with_spectra(TrainConfig(), rgb={"train_from": 0.1}, thermal={"train_from": 0.1})
    assert "after 0 of the steps" in refused(late).message
    early = with_spectra(TrainConfig(), rgb={"train_until": 0.9}, thermal={"train_until": 0.8})
    assert "after 0.9 of the steps" in refused(early).message
    check_config(with_spectra(TrainConfig(), rgb={"train_until": 0.5}, thermal={"train_from": 0.5}))


def test_schedule_of_a_single_spectrum() -> None:
    """What divides a run between spectra leaves steps without any where one is modelled alone."""
    config = with_spectra(TrainConfig(), thermal={"train_from": 0.5})
    check_config(config)
    error = refused(replace(config, without=("rgb",)))
    assert error.message == (
        "--thermal.train-from would leave steps without anything to train on: only thermal is modelled."
    )
    check_config(replace(config, without=("thermal",)))


def test_gaussians_start_from_trained_ones() -> None:
    """A copy of the RGB set before its first step would never be made; from the first step on it is."""
    config = load_config("thermalgaussian_mftg")
    for share, steps in ((0.0, 60_000), (0.004, 100)):
        early = replace(with_spectra(config, thermal={"train_from": share}), max_steps=steps)
        message = refused(early).message
        assert message.startswith("--thermal.start rgb copies that set when training of thermal begins")
        assert f"with --thermal.train-from {share} of {steps} steps it begins before RGB has been trained." in message
    check_config(replace(with_spectra(config, thermal={"train_from": 0.01}), max_steps=100))


def test_gaussians_start_from_a_set_that_is_trained_before() -> None:
    """Of three sets, one that begins later than the copy is made cannot be copied."""
    config = with_spectra(load_config("thermalgaussian_mftg"), nir={"start": "thermal", "train_from": 0.6})
    check_config(config)
    for share in (0.4, 0.5):
        message = refused(with_spectra(config, nir={"train_from": share})).message
        assert message.startswith("--nir.start thermal copies that set when training of NIR begins")
        assert "it begins before thermal has been trained" in message


def test_gaussians_start_from_a_set_of_their_own() -> None:
    """There is nothing to copy where all share one set, or where the other spectrum is left out."""
    shared = with_spectra(TrainConfig(), thermal={"start": "rgb", "train_from": 0.5})
    expected = (
        "--thermal.start rgb copies one set of Gaussians to another, which needs separate sets of thermal and RGB."
    )
    assert refused(shared).message == expected
    alone = with_spectra(load_config("3dgs"), thermal={"start": "rgb"})
    assert refused(replace(alone, without=("rgb",))).message == expected
