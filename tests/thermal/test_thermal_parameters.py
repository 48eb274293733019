"""What is known of a capture's temperatures: by its files, and by a person's YAML."""

from pathlib import Path

import pytest

from thermosplat.errors import UserError
from thermosplat.thermal.thermal_parameters import ThermalParameters, capture_parameters, parameters_text


def test_nothing_is_known(tmp_path: Path) -> None:
    """Without either file."""
    assert capture_parameters(tmp_path) is None


def test_medians_over_the_files(tmp_path: Path) -> None:
    """Numbers that differ from image to image are told, and their median stands for all of them."""
    images = {
        f"{number}.png": ThermalParameters(applied=True, emissivity=0.95, distance_metres=float(number))
        for number in (1, 2, 9)
    }
    (tmp_path / "thermal_parameters.json").write_text(parameters_text(images))
    known = capture_parameters(tmp_path)
    assert known is not None
    assert known.stated == ThermalParameters(applied=True, emissivity=0.95, distance_metres=2.0)
    assert len(known.notes) == 1
    assert "distance_metres ranges from 1 to 9" in known.notes[0]


def test_a_persons_word_goes_before_the_files(tmp_path: Path) -> None:
    """What thermal_parameters.yaml does not say stays."""
    images = {"1.png": ThermalParameters(applied=True, emissivity=0.95, humidity=0.4)}
    (tmp_path / "thermal_parameters.json").write_text(parameters_text(images))
    (tmp_path / "thermal_parameters.yaml").write_text("applied: true\nemissivity: 0.9\n")
    known = capture_parameters(tmp_path)
    assert known is not None
    assert known.stated == ThermalParameters(applied=True, emissivity=0.9, humidity=0.4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("emissivity: 0.9", "must say what the capture's temperatures are: applied"),
        ("applied: true\nemisivity: 0.9", "has 'emisivity'; known are applied, emissivity"),
        ("applied: true\nemissivity: [1]", "states what is no number"),
        ("applied: true\nplanck: {r1: 1}", "states what is no number"),
    ],
)
def test_a_damaged_yaml(tmp_path: Path, text: str, message: str) -> None:
    """A sentence says what is wrong with it."""
    (tmp_path / "thermal_parameters.yaml").write_text(text + "\n")
    with pytest.raises(UserError) as caught:
        capture_parameters(tmp_path)
    assert message in caught.value.message
