"""What temperatures are recalculated with: ranges, and files of values by label."""

import re
from pathlib import Path

import pytest

from thermosplat.config.temperature_settings import TemperatureSettings, read_labels
from thermosplat.errors import UserError


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"emissivity": 95.0}, "--emissivity must be 0.01 to 1, found 95.*95% is 0.95"),
        ({"emissivity": float("nan")}, "--emissivity must be"),
        ({"humidity": 50.0}, "--humidity must be 0 to 1, found 50.*50% is 0.5"),
        ({"reflected": 293.15e3}, "--reflected must be -100 to 3000 °C"),
        ({"window": 0.0}, "--window must be"),
    ],
)
def test_impossible_settings(wrong: dict[str, float], message: str) -> None:
    """Percent, kelvin and the like are told with what was expected."""
    with pytest.raises(UserError) as caught:
        TemperatureSettings(**wrong).checked()
    assert re.search(message, f"{caught.value.message} {caught.value.hint}")


def test_labels_are_read(tmp_path: Path) -> None:
    """Each label has its name and values; what it does not say is the scene's."""
    path = tmp_path / "labels.yaml"
    path.write_text("1: {name: glass, emissivity: 0.86, reflected: -10}\n5: {name: chrome, mirror: true}\n")
    labels = read_labels(path)
    assert labels[1].settings == TemperatureSettings(emissivity=0.86, reflected=-10.0)
    assert (labels[5].name, labels[5].mirror) == ("chrome", True)
    scene = TemperatureSettings(emissivity=0.95, air=12.0)
    assert labels[1].settings.over(scene) == TemperatureSettings(emissivity=0.86, reflected=-10.0, air=12.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wall: {emissivity: 0.9}", "is no label"),
        ("300: {emissivity: 0.9}", "is no label"),
        ("1: 0.9", "label 1 must be a group"),
        ("1: {emisivity: 0.9}", "has 'emisivity'; known are name, mirror, emissivity"),
        ("1: {emissivity: high}", "expected a number"),
        ("1: {emissivity: 9}", "label 1: emissivity must be 0.01 to 1"),
    ],
)
def test_damaged_label_files(tmp_path: Path, text: str, message: str) -> None:
    """A sentence says which label is wrong and what was expected."""
    path = tmp_path / "labels.yaml"
    path.write_text(text + "\n")
    with pytest.raises(UserError) as caught:
        read_labels(path)
    assert message in caught.value.message
