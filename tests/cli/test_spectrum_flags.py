"""Flags of one spectrum's settings: their short form, spectra that a configuration file defines, and typing errors."""

from pathlib import Path

import pytest

from thermosplat.cli.arguments import parse_train_arguments
from thermosplat.cli.spectrum_flags import named_spectra, refuse_unknown_spectra, with_groups
from thermosplat.config.files import load_config
from thermosplat.errors import UserError
from thermosplat.spectra import DEFAULT_SPECTRA, SpectrumConfig
from toy_scene import with_spectra

TEXT = """
base: demo
spectra:
  nir: {unit: reflectance}
  red_edge: {}
"""


@pytest.fixture
def file(tmp_path: Path) -> str:
    """A configuration with two further spectra."""
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT)
    return str(path)


def test_short_flags_are_those_of_the_group() -> None:
    """Of the named spectra alone; other words stay as they are."""
    words = ["data/x.y", "--thermal.unit", "celsius", "--model.feature-dim=0", "--spectra.rgb.loss", "--rgb.loss", "-1"]
    assert with_groups(words, ["rgb", "thermal"]) == [
        *("data/x.y", "--spectra.thermal.unit", "celsius", "--model.feature-dim=0", "--spectra.rgb.loss"),
        *("--spectra.rgb.loss", "-1"),
    ]
    assert with_groups(["--red-edge.no-aligned", "--red_edge.unit"], ["red_edge"]) == [
        *("--spectra.red-edge.no-aligned", "--spectra.red_edge.unit"),
    ]


@pytest.mark.parametrize(
    ("flags", "name", "settings"),
    [
        ("--nir.range 0 1", "nir", {"range": (0.0, 1.0)}),
        ("--spectra.nir.range 0 1", "nir", {"range": (0.0, 1.0)}),
        ("--nir.factor=0.5", "nir", {"factor": 0.5}),
        ("--nir.features None --nir.aligned", "nir", {"features": None, "aligned": True}),
        ("--nir.folders Band5 nir", "nir", {"folders": ("Band5", "nir")}),
        ("--red-edge.opacity own", "red_edge", {"opacity": "own"}),
        ("--red_edge.train_from 0.5", "red_edge", {"train_from": 0.5}),
        ("--spectra.red-edge.no-aligned --red-edge.modulated-by nir", "red_edge", {"modulated_by": "nir"}),
        ("--thermal.palette iron --thermal.smoothness 0", "thermal", {"palette": "iron", "smoothness": 0.0}),
    ],
)
def test_flags_of_spectra_that_a_file_defines(file: str, flags: str, name: str, settings: dict[str, object]) -> None:
    """They change that setting alone, wherever --config stands."""
    expected = with_spectra(load_config(file), **{name: settings}).spectra
    for words in ([*flags.split(), "--config", file], ["--config", file, *flags.split()]):
        assert parse_train_arguments(["data/x", *words]).spectra == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--nir.range", "0", "1"], '--nir.range: there is no spectrum "nir".'),
        (["--termal.unit", "celsius"], '--termal.unit: there is no spectrum "termal" (did you mean "thermal"?).'),
        (["--spectra.uv.no-aligned"], '--spectra.uv.no-aligned: there is no spectrum "uv".'),
        (["--red-edge.unit", "x"], '--red-edge.unit: there is no spectrum "red_edge".'),
    ],
)
def test_flags_of_spectra_that_nobody_defines(words: list[str], expected: str) -> None:
    """The flag, the nearest spectrum, those that there are, and where others are defined."""
    with pytest.raises(UserError) as caught:
        parse_train_arguments(["data/x", *words])
    assert caught.value.message == expected
    assert caught.value.hint.startswith("The spectra are rgb, thermal; a configuration file defines others")


def test_a_mistyped_setting_gets_a_suggestion(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a spectrum that a file defines too."""
    with pytest.raises(SystemExit) as stop:
        parse_train_arguments(["data/x", "--config", file, "--nir.rang", "0", "1"])
    assert stop.value.code == 2
    assert "--spectra.nir.range" in capsys.readouterr().err


def test_other_flags_name_no_spectrum() -> None:
    """Groups of settings, flags of other trainers, and words without a setting."""
    words = ["--model.feature-dim", "0", "--loss.features", "--viewer.port", "7007", "--nir", "x.unit", "--spectra.nir"]
    assert named_spectra(words, DEFAULT_SPECTRA) == DEFAULT_SPECTRA
    refuse_unknown_spectra(words, DEFAULT_SPECTRA)
    assert named_spectra(["--nir.unit=x"], DEFAULT_SPECTRA) == {**DEFAULT_SPECTRA, "nir": SpectrumConfig()}


def test_help_has_the_settings_of_every_spectrum(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    """With the values of the file."""
    with pytest.raises(SystemExit) as stop:
        parse_train_arguments(["--config", file, "--help-all"])
    assert stop.value.code == 0
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())  # lines end where the terminal does
    for name in ("rgb", "thermal", "nir", "red-edge"):
        assert f"--spectra.{name}.unit STR" in printed
    assert "(default: reflectance)" in printed


def test_spectra_are_left_out(file: str) -> None:
    """--without takes several; a name that is none is refused with a suggestion."""
    config = parse_train_arguments(["data/x", "--config", file, "--without", "thermal", "red_edge"])
    assert list(config.modelled) == ["rgb", "nir"]
    with pytest.raises(UserError, match=r'--without: there is no spectrum "red-edge" \(did you mean "red_edge"\?\)\.'):
        parse_train_arguments(["data/x", "--config", file, "--without", "red-edge"])
