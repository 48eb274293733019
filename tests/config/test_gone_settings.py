"""Configurations with settings that there are no more are read, or a sentence says why not."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml

from thermosplat.config import TrainConfig
from thermosplat.config.files import from_dict, load_config, to_dict
from thermosplat.config.gone_settings import GONE, without_gone_settings
from thermosplat.errors import UserError
from toy_scene import with_spectra


def test_todays_configurations_stay_as_they_are() -> None:
    """Nothing is renamed, added or taken away."""
    for config in (TrainConfig(), load_config("mmone"), with_spectra(TrainConfig(), nir={"unit": "reflectance"})):
        assert without_gone_settings(to_dict(config), source="") == to_dict(config)


def other_value(name: str) -> Any:
    """A value of a setting that there is no more, for something else than what is done today."""
    first = GONE[name].neutral[0]
    return "another" if isinstance(first, str) else not first if isinstance(first, bool) else first + 7


def of_thermal(name: str) -> dict[str, Any]:
    """Nested dictionaries with one such setting, yet without its value, by the name of the innermost."""
    *groups, key = name.replace("*", "thermal").split(".")
    values: dict[str, Any] = {key: None}
    for group in reversed(groups):
        values = {group: values}
    return values


def filled(values: dict[str, Any], value: Any) -> dict[str, Any]:
    return {key: filled(inner, value) if isinstance(inner, dict) else value for key, inner in values.items()}


@pytest.mark.parametrize("name", GONE)
def test_a_setting_that_is_gone(name: str, tmp_path: Path) -> None:
    """What asks for what is done today is dropped silently. Else it is a mistake in a file, and told of what is
    trained, but where images of such a model would be wrong."""
    file = tmp_path / "mine.yaml"
    for value in GONE[name].neutral:
        file.write_text(yaml.safe_dump(filled(of_thermal(name), value)))
        assert load_config(file) == dataclasses.replace(TrainConfig(), config="mine")
        notes: list[str] = []
        assert from_dict(filled(of_thermal(name), value), notes=notes) == TrainConfig()
        assert not notes
    values = filled(of_thermal(name), other_value(name))
    file.write_text(yaml.safe_dump(values))
    full = name.replace("*", "thermal")
    with pytest.raises(
        UserError, match=f"{full} is no setting any more, found {other_value(name)!r}. [A-Z].*[.]"
    ) as caught:
        load_config(file)
    assert "mine.yaml" in caught.value.message
    assert caught.value.hint == "Remove the line."
    if GONE[name].shapes_images:
        with pytest.raises(UserError, match=f"{full} is no setting any more"):
            from_dict(values, notes=[])
    else:
        assert from_dict(values, notes=notes) == TrainConfig()
        assert len(notes) == 1
        assert full in notes[0]


def test_rates_of_opacities_that_were_the_same() -> None:
    """What a configuration of demo says of offsets is what every opacity has; another rate is none of today's."""
    rates = {"opacities_lr": 0.075, "opacity_offsets_lr": 0.075, "own_opacities_lr": 0.05}
    assert from_dict({"optimizer": rates}).optimizer.opacities_lr == 0.075
    with pytest.raises(UserError, match=r"optimizer\.opacity_offsets_lr is no setting any more, found 0\.075"):
        from_dict({"optimizer": {**rates, "opacities_lr": 0.05}})


@pytest.mark.parametrize(
    ("thresholds", "by_noise"),
    [
        ({"loss_noise": 0.0125, "smoothness_noise": 0.0}, True),
        ({"loss_noise": 0.0, "point_spread_noise": 0.0125}, True),
        ({"loss_noise": 0.0, "smoothness_noise": 0.0, "point_spread_noise": 0.0}, False),
    ],
)
def test_thresholds_of_noise_were_all_the_same(thresholds: dict[str, float], by_noise: bool, tmp_path: Path) -> None:
    """Where one of them stood noise decides; zeros on top of a preset switch that off; another one is a mistake."""
    assert from_dict({"spectra": {"nir": thresholds}}).spectra["nir"].by_noise == by_noise
    (tmp_path / "mine.yaml").write_text(
        yaml.safe_dump({"base": "thermosplat_plus", "spectra": {"thermal": thresholds}})
    )
    assert load_config(tmp_path / "mine.yaml").spectra["thermal"].by_noise == by_noise
    with pytest.raises(UserError, match=r"spectra\.nir\.loss_noise is no setting any more, found 0\.02"):
        from_dict({"spectra": {"nir": {**thresholds, "loss_noise": 0.02}}})


def test_a_choice_that_is_gone(tmp_path: Path) -> None:
    """Told of what is trained; in a file a mistake that names the choices there are."""
    notes: list[str] = []
    assert from_dict({"decoder_precision": "bfloat16"}, notes=notes) == TrainConfig()
    assert notes == ["the configuration: bfloat16 is no decoder_precision any more. Decoders train in float32 or tf32."]
    (tmp_path / "mine.yaml").write_text("decoder_precision: bfloat16\n")
    with pytest.raises(UserError, match='must be one of "float32", "tf32", found'):
        load_config(tmp_path / "mine.yaml")
