"""Configurations of older versions are read as today's."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import yaml

from thermosplat.config import AutoBudgetConfig, TrainConfig
from thermosplat.config.files import from_dict, load_config, to_dict
from thermosplat.config.renamed import GONE, NEW_NAMES, gone, with_todays_names
from thermosplat.config.run_schedule import in_steps
from thermosplat.errors import UserError
from toy_scene import with_spectra

OLD_PRESETS = {
    "thermosplat": """
max_steps: 30000
test_every: 8
sh_degree: 3
sh_degree_interval: 1000
model: {gaussian_sets: shared, feature_dim: 8, geometric_decoupling: true}
decoder: {modulation: true, hybrid_rgb: true, hidden_dim: 64, hidden_layers: 2}
loss:
  ssim_lambda: 0.2
  rgb: 1.0
  thermal: 1.0
  features: 1.0
  features_rgb: 1.0
  features_thermal: 0.5
  thermal_smoothness: 0.3
densification: {start_step: 500, stop_step: 15000, every: 100, grad_threshold: 0.0004, reset_every: 3000}
""",
    "no_geometric_decoupling": """
base: thermosplat
model: {geometric_decoupling: false}
""",
    "no_hybrid_rgb": """
base: thermosplat
decoder: {hybrid_rgb: false}
""",
    "no_rgb_feature_loss": """
base: thermosplat
loss: {features_rgb: 0.0}
""",
    "no_thermal_feature_loss": """
base: thermosplat
loss: {features_thermal: 0.0}
""",
    "3dgs": """
base: thermosplat
model: {gaussian_sets: separate, feature_dim: 0, geometric_decoupling: false}
loss: {features: 0.0, thermal_smoothness: 0.0}
densification: {grad_threshold: 0.0002}
""",
    "thermalgaussian_mftg": """
base: 3dgs
max_steps: 60000
model: {thermal_start: rgb}
schedule: {rgb_until: 0.5, thermal_from: 0.5}
loss: {thermal_smoothness: 0.6}
""",
    "thermalgaussian_msmg": """
base: 3dgs
loss: {balance: true, rgb: 0.3, thermal: 0.6, thermal_smoothness: 0.36}
""",
    "thermalgaussian_ommg": """
base: thermosplat
model: {feature_dim: 0, geometric_decoupling: false}
loss: {rgb: 0.5, thermal: 0.5, features: 0.0, thermal_smoothness: 0.3}
densification: {grad_threshold: 0.0002}
""",
    "mmone": """
base: thermalgaussian_ommg
model: {geometric_decoupling: true, thermal_opacity: own}
densification: {decompose_threshold: 0.0002}
""",
    "ms_splatting": """
base: thermosplat
max_steps: 75000
sh_degree: 0
model: {feature_dim: 16, geometric_decoupling: false}
decoder:
  branches: separate
  modulation: false
  hybrid_rgb: false
  view_direction: true
  hidden_dim: 16
  hidden_layers: 2
schedule: {thermal_from: 0.4}
loss: {features: 0.0, thermal_smoothness: 0.0, feature_norm: 0.1}
optimizer: {features_lr: 0.005, features_lr_final: 0.005, decoders_lr: 0.005, decoders_lr_final: 0.005}
densification:
  absgrad: true
  grad_threshold: 0.0008
  every: 300
  stop_step: 45000
  reset_every: 9000
  prune_opacity: 0.1
  reset_opacity: 0.2
""",
    "thermosplat_plus": """
base: thermosplat
budget: auto
model: {init_opacity: 0.5, init_scale: 1.0}
loss:
  opacity_reg: 0.01
  scale_reg: 0.01
  depth_spread: 0.3
  thermal_smoothness: 0.3
  thermal_smoothness_noise: 0.0125
  thermal_smoothness_least: 0.05
densification: {strategy: mcmc, max_gaussians: 300000, stop_step: 25000}
optimizer: {features_lr_final: 0.00025, final_share: 0.05}
""",
}
"""The presets as version 0.1 had them, without their comments."""
BY_TODAYS_NAMES = {
    "thermosplat_plus": """
base: thermosplat
budget: auto
spectra: {thermal: {smoothness: 0.3, by_noise: true}}
model: {init_opacity: 0.5}
loss: {opacity_reg: 0.01, scale_reg: 0.01, depth_spread: 0.3}
densification: {strategy: mcmc, max_gaussians: 300000, stop_step: 25000}
optimizer: {features_lr_final: 0.00025, final_share: 0.05}
""",
}
"""Those that have other settings today."""

VALUES: dict[str, Any] = {
    "thermal.source": "raw",
    "thermal.unit": "kelvin",
    "thermal.range_celsius": (1.0, 2.0),
    "thermal.palette": "hot.csv",
    "thermal.aligned": True,
    "model.thermal_opacity": "own",
    "model.thermal_start": "rgb",
    "decoder.hybrid_rgb": False,
}
"""A value that each setting could have; 0.25 of all others."""


def nested(name: str, value: Any) -> dict[str, Any]:
    group, _, key = name.partition(".")
    return {group: {key: value}}


def at(values: dict[str, Any], name: str) -> Any:
    for key in name.split("."):
        values = values[key]
    return values


def old_files(folder: Path) -> None:
    """The old presets in a folder, each named as its base is named by the others."""
    for name, text in OLD_PRESETS.items():
        values = yaml.safe_load(text)
        if "base" in values:
            values["base"] = f"old_{values['base']}.yaml"
        (folder / f"old_{name}.yaml").write_text(yaml.safe_dump(values))


@pytest.mark.parametrize("name", OLD_PRESETS)
def test_a_preset_of_version_0_1_is_todays(name: str, tmp_path: Path) -> None:
    """Each old file, on old files or on today's preset, describes what today's preset of that name does, or what the
    same settings are by today's names where the preset has others since."""

    def described(file: str) -> TrainConfig:
        config = in_steps(load_config(tmp_path / file))
        newer: dict[str, Any] = {"refine_from": 0, "auto_budget": AutoBudgetConfig()}  # than version 0.1
        return dataclasses.replace(config, config=name, **newer)

    old_files(tmp_path)
    (tmp_path / "then.yaml").write_text(BY_TODAYS_NAMES.get(name, f"base: {name}"))
    today = described("then.yaml")
    assert described(f"old_{name}.yaml") == today
    (tmp_path / "mine.yaml").write_text(OLD_PRESETS[name])
    if today.max_steps == TrainConfig().max_steps:  # else today's base has shares of these steps
        assert described("mine.yaml") == today


@pytest.mark.parametrize("old", [old for old in NEW_NAMES if gone(old) is None])
def test_every_old_name(old: str) -> None:
    """Alone, it is the new name with the same value, which a configuration takes; nothing of the old group is left."""
    new, value = NEW_NAMES[old], VALUES.get(old, 0.25)
    values = nested(old, value)
    found = with_todays_names(values, source="")
    assert at(found, new) == value
    assert values == nested(old, value)
    if old.partition(".")[0] not in new:
        assert old.partition(".")[0] not in found
    if old in ("model.thermal_start", "schedule.rgb_until"):  # excluded by checks where they stand alone
        return
    config = to_dict(from_dict(nested(old, value)))
    assert at(config, new) == value
    assert at(to_dict(TrainConfig()), new) != value


@pytest.mark.parametrize("old", [old for old in NEW_NAMES if gone(old) is None])
def test_todays_name_wins(old: str) -> None:
    """A file that has a setting under both names means the new one."""
    both = nested(old, VALUES.get(old, 0.25))
    *groups, key = NEW_NAMES[old].split(".")
    inner = both
    for group in groups:
        inner = inner.setdefault(group, {})
    inner[key] = "today's"
    assert at(with_todays_names(both, source=""), NEW_NAMES[old]) == "today's"


def test_todays_configurations_stay_as_they_are() -> None:
    """Nothing is renamed, added or taken away."""
    for config in (TrainConfig(), load_config("mmone"), with_spectra(TrainConfig(), nir={"unit": "reflectance"})):
        assert with_todays_names(to_dict(config), source="") == to_dict(config)


@pytest.mark.parametrize(
    ("model", "modelled"),
    [
        ({"thermal": False}, ["rgb"]),
        ({"rgb": False}, ["thermal"]),
        ({"rgb": True, "thermal": False}, ["rgb"]),
        ({"rgb": True, "thermal": True}, ["rgb", "thermal"]),
    ],
)
def test_spectra_that_were_not_modelled(model: dict[str, bool], modelled: list[str]) -> None:
    """They are left out today."""
    assert list(from_dict({"model": model}).modelled) == modelled


def test_a_spectrum_is_modelled_again(tmp_path: Path) -> None:
    """What an old base switched off, a file on top of it switches on."""
    (tmp_path / "base.yaml").write_text("model: {thermal: false}\n")
    (tmp_path / "mine.yaml").write_text("base: base.yaml\nmodel: {thermal: true}\n")
    assert list(load_config(tmp_path / "base.yaml").modelled) == ["rgb"]
    assert list(load_config(tmp_path / "mine.yaml").modelled) == ["rgb", "thermal"]


@pytest.mark.parametrize(
    ("model", "opacity"),
    [
        ({"geometric_decoupling": False}, "shared"),
        ({"geometric_decoupling": False, "thermal_opacity": "own"}, "shared"),
        ({"geometric_decoupling": True}, "offset"),
        ({"geometric_decoupling": True, "thermal_opacity": "own"}, "own"),
        ({"thermal_opacity": "own"}, "own"),
    ],
)
def test_two_switches_of_the_opacity(model: dict[str, Any], opacity: str, tmp_path: Path) -> None:
    """One choice of three today, on top of a preset too."""
    assert from_dict({"model": model}).spectra["thermal"].opacity == opacity
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"base": "no_geometric_decoupling", "model": model}))
    assert load_config(tmp_path / "mine.yaml").spectra["thermal"].opacity == opacity


def test_decomposition_was_a_threshold() -> None:
    """It is a strategy today; null was none, also on top of a preset that has one."""
    values = with_todays_names({"densification": {"decompose_threshold": 2e-4, "strategy": "default"}}, source="")
    assert values == {"densification": {"strategy": "decomposing"}}
    with pytest.raises(UserError, match=r"conflict_threshold is no setting any more, found 0\.0003"):
        with_todays_names({"densification": {"decompose_threshold": 3e-4}}, source="")
    for stated in ({}, {"strategy": "default"}):
        values = with_todays_names({"densification": {"decompose_threshold": None, **stated}}, source="")
        assert values == {"densification": {"strategy": "default"}}
    values = with_todays_names({"densification": {"decompose_threshold": None, "strategy": "mcmc"}}, source="")
    assert values == {"densification": {"strategy": "mcmc"}}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("model: {thermal: maybe}\n", 'unknown key "model.thermal"'),
        ("model: {geometric_decoupling: 3}\n", 'unknown key "model.geometric_decoupling"'),
        ("densification: {decompose_threshold: much}\n", "conflict_threshold is no setting any more, found 'much'"),
        ("thermal: {rang: 3}\n", 'unknown key "thermal"'),
        ("thermal: 3\n", 'unknown key "thermal"'),
        ("schedule: {thermal_until: 0.5}\n", 'unknown key "schedule"'),
        ("spectra: 3\nloss: {rgb: 2.0}\n", '"spectra" holds groups of settings by name, found 3'),
        ("spectra: {rgb: 3}\nloss: {rgb: 2.0}\n", '"spectra.rgb" is a group of settings, found 3'),
        ("without: thermal\nmodel: {rgb: false}\n", '"without" must be a list'),
    ],
)
def test_what_was_never_a_value_is_a_mistake(text: str, expected: str, tmp_path: Path) -> None:
    """As strict as with today's names."""
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(UserError) as caught:
        load_config(tmp_path / "mine.yaml")
    assert expected in caught.value.message
    assert "mine.yaml" in caught.value.message


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


def test_density_control_that_was_switched_off() -> None:
    """It never began; opacities were reset to twice what is pruned."""
    off = {"densification": {"enabled": False, "stop_step": 15_000, "prune_opacity": 0.1, "reset_opacity": 0.2}}
    assert from_dict(off).densification.stop_step == 0
    assert from_dict({"densification": {"enabled": True}}) == TrainConfig()
    with pytest.raises(UserError, match=r'unknown key "densification\.enabled"'):
        from_dict({"densification": {"enabled": "no"}})


def test_a_choice_that_is_gone(tmp_path: Path) -> None:
    """Told of what is trained; in a file a mistake that names the choices there are."""
    notes: list[str] = []
    assert from_dict({"decoder_precision": "bfloat16"}, notes=notes) == TrainConfig()
    assert notes == ["the configuration: bfloat16 is no decoder_precision any more. Decoders train in float32 or tf32."]
    (tmp_path / "mine.yaml").write_text("decoder_precision: bfloat16\n")
    with pytest.raises(UserError, match='must be one of "float32", "tf32", found'):
        load_config(tmp_path / "mine.yaml")


def test_an_old_name_of_a_setting_that_is_gone(tmp_path: Path) -> None:
    """Version 0.1's names are followed, and what a spectrum is called does not matter."""
    for old in filter(gone, NEW_NAMES):
        assert from_dict(nested(old, GONE[NEW_NAMES[old].replace(".thermal.", ".*.")].neutral[0])) == TrainConfig()
    (tmp_path / "mine.yaml").write_text("optimizer: {exposures_lr: 0.5}\n")
    with pytest.raises(UserError, match="Exposures are solved for"):
        load_config(tmp_path / "mine.yaml")
