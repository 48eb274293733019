"""Presets, user's files and resolved configurations as YAML."""

from dataclasses import replace
from pathlib import Path

import pytest

from thermosplat.config import TrainConfig
from thermosplat.config import files as config_files
from thermosplat.config.files import (
    data_from_anywhere,
    files_from_anywhere,
    from_dict,
    load_config,
    preset_paths,
    to_dict,
    to_yaml,
)
from thermosplat.errors import UserError
from thermosplat.spectra import SpectrumConfig
from toy_scene import with_spectra

BASELINES = {
    *("3dgs", "thermalgaussian_mftg", "thermalgaussian_msmg", "thermalgaussian_ommg", "ms_splatting", "mmone"),
}
FULL = TrainConfig()
ABLATIONS = {
    "mlp_based": replace(FULL, decoder=replace(FULL.decoder, modulation=False)),
    "no_geometric_decoupling": with_spectra(FULL, thermal={"opacity": "shared"}),
    "no_hybrid_rgb": replace(FULL, decoder=replace(FULL.decoder, hybrid=False)),
    "no_thermal_feature_loss": with_spectra(FULL, thermal={"features": 0.0}),
    "no_rgb_feature_loss": with_spectra(FULL, rgb={"features": 0.0}),
}


def write(folder: Path, text: str, name: str = "mine.yaml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_presets_are_the_documented_ones() -> None:
    """Every preset of the documentation exists, and no other."""
    ours = {"thermosplat", "thermosplat_plus", "thermosplat_fast", "demo"}
    assert set(preset_paths()) == {*ours, *BASELINES, *ABLATIONS}


@pytest.mark.parametrize("name", preset_paths())
def test_preset_survives_yaml_and_dict(name: str, tmp_path: Path) -> None:
    """The resolved configuration of every preset reads back to an equal one."""
    config = load_config(name)
    assert config.config == name
    assert from_dict(to_dict(config)) == config
    assert load_config(write(tmp_path, to_yaml(config), "config.yaml")) == config


def test_thermosplat_preset_is_the_schema_default() -> None:
    """thermosplat.yaml restates the schema's defaults, so that the two cannot drift apart."""
    assert load_config("thermosplat") == TrainConfig()


@pytest.mark.parametrize("name", ABLATIONS)
def test_ablation_changes_one_thing(name: str) -> None:
    """An ablation differs from the full method in exactly the field it is named for."""
    assert load_config(name) == replace(ABLATIONS[name], config=name)
    assert ABLATIONS[name] != FULL


def test_baseline_trains_each_spectrum_alone() -> None:
    """3dgs.yaml has separate Gaussians without features, and 3DGS's own schedule."""
    config = load_config("3dgs")
    assert (config.model.gaussian_sets, config.model.feature_dim) == ("separate", 0)
    assert (config.loss.features, config.spectra["thermal"].smoothness) == (0.0, 0.0)
    assert config.densification == replace(TrainConfig().densification, grad_threshold=2e-4)


def test_file_states_only_differences(tmp_path: Path) -> None:
    """A file inherits from its base; scientific notation without a point is a number."""
    config = load_config(write(tmp_path, "base: 3dgs\noptimizer:\n  scales_lr: 1e-3\nbackground: [1, 1, 1]\n"))
    assert config.config == "mine"
    assert config.model.gaussian_sets == "separate"
    assert config.optimizer.scales_lr == 0.001
    assert config.background == (1.0, 1.0, 1.0)


def test_steps_of_a_file_are_meant(tmp_path: Path) -> None:
    """What images ask for in a base belongs to the base's steps."""
    seeded = load_config(write(tmp_path, "base: thermosplat_plus\nseed: 1\n"))
    assert (seeded.steps_for_views, seeded.noisy_steps) == (45, 1.5)
    given = load_config(write(tmp_path, "base: thermosplat_plus\nmax_steps: 9000\n"))
    assert (given.steps_for_views, given.noisy_steps) == (None, 1.0)
    both = load_config(write(tmp_path, "base: thermosplat_plus\nmax_steps: 900\nsteps_for_views: 10\nnoisy_steps: 2\n"))
    assert (both.steps_for_views, both.noisy_steps) == (10, 2.0)


@pytest.mark.parametrize("preset", ["demo", "thermosplat", "thermosplat_fast", "3dgs"])
def test_noise_asks_other_presets_for_no_steps(preset: str) -> None:
    """Only thermosplat_plus was measured with more."""
    assert load_config(preset).noisy_steps == 1.0


def test_a_further_spectrum_is_a_few_lines(tmp_path: Path) -> None:
    """It starts from the defaults and comes after those of the base, which keep theirs; null is a value."""
    nir = "  nir:\n    unit: reflectance\n    factor: 1e-4\n    features: null\n"
    config = load_config(write(tmp_path, f"base: demo\nspectra:\n{nir}  rgb:\n    loss: 2\n"))
    base = load_config("demo")
    assert list(config.spectra) == ["rgb", "thermal", "nir"]
    assert config.spectra["nir"] == SpectrumConfig(unit="reflectance", factor=1e-4, features=None)
    assert config.spectra["rgb"] == replace(base.spectra["rgb"], loss=2.0)
    assert replace(config, spectra=base.spectra, config="demo") == base
    assert from_dict(to_dict(config)) == config
    assert load_config(write(tmp_path, to_yaml(config), "config.yaml")) == config
    again = load_config(write(tmp_path, "base: mine.yaml\nspectra:\n  nir:\n    opacity: offset\n", "again.yaml"))
    assert again.spectra["nir"] == replace(config.spectra["nir"], opacity="offset")


def test_files_do_not_share_their_spectra(tmp_path: Path) -> None:
    """What one file defines is not in the configuration that is loaded next."""
    load_config(write(tmp_path, "spectra:\n  nir: {}\n"))
    assert list(load_config("thermosplat").spectra) == ["rgb", "thermal"]
    assert list(TrainConfig().spectra) == ["rgb", "thermal"]


def test_spectra_that_are_left_out(tmp_path: Path) -> None:
    """They are not modelled, and keep their settings."""
    config = load_config(write(tmp_path, "spectra:\n  nir: {}\nwithout: [thermal]\n"))
    assert list(config.modelled) == ["rgb", "nir"]
    assert list(config.spectra) == ["rgb", "thermal", "nir"]
    assert config.modelled["nir"] == config.spectra["nir"]


def test_palettes_are_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of any spectrum by its absolute path; the names of built-in palettes stay."""
    monkeypatch.chdir(tmp_path)
    config = with_spectra(TrainConfig(), nir={"palette": "iron"}, thermal={"palette": "hot.csv"}, uv={})
    spectra = files_from_anywhere(config).spectra
    assert spectra["thermal"].palette == str(tmp_path / "hot.csv")
    assert (spectra["nir"].palette, spectra["uv"].palette) == ("iron", "grey")
    assert spectra["rgb"] == config.spectra["rgb"]


def test_base_may_be_a_file_beside(tmp_path: Path) -> None:
    """A base is looked for beside the file that names it."""
    write(tmp_path, "max_steps: 12\n", "short.yaml")
    assert load_config(write(tmp_path, "base: short.yaml\nseed: 1\n")).max_steps == 12


def test_presets_are_found_in_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package finds the presets inside itself, before any folder above."""
    (tmp_path / "thermosplat" / "configs").mkdir(parents=True)
    write(tmp_path / "thermosplat" / "configs", "max_steps: 3\n", "thermosplat.yaml")
    monkeypatch.setattr(config_files, "__file__", str(tmp_path / "thermosplat" / "config" / "files.py"))
    config_files.presets_folder.cache_clear()
    try:
        assert load_config("thermosplat").max_steps == 3
    finally:
        config_files.presets_folder.cache_clear()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("max_stesp: 3\n", 'unknown key "max_stesp" (did you mean "max_steps"?)'),
        ("densification:\n  stop_stp: 3\n", 'unknown key "densification.stop_stp" (did you mean "stop_step"?)'),
        ("loss: 3\n", '"loss" is a group of settings, found 3'),
        ("max_steps: many\n", "\"max_steps\" must be a whole number, found 'many'"),
        ("max_steps: true\n", '"max_steps" must be a whole number, found True'),
        ("model:\n  gaussian_sets: sepparate\n", 'must be one of "shared", "separate", found \'sepparate\''),
        ("background: [0, 0]\n", '"background" must be a list of 3, each a number'),
        (
            "spectra:\n  thermal:\n    range: hot\n",
            '"spectra.thermal.range" must be a list of 2, each a number',
        ),
        ("spectra:\n  thermal:\n    rang: 3\n", 'unknown key "spectra.thermal.rang" (did you mean "range"?)'),
        ("spectra:\n  nir:\n    opacity: sharde\n", "found 'sharde' (did you mean \"shared\"?)"),
        ("spectra: nir\n", "\"spectra\" holds groups of settings by name, found 'nir'"),
        ("spectra:\n  nir: 3\n", '"spectra.nir" is a group of settings, found 3'),
        ("spectra:\n  NIR: {}\n", '"NIR" cannot be the name of a spectrum'),
        ("spectra:\n  nir:\n    factor: 0\n", "spectra.nir.factor must be positive, found 0.0"),
        ("without: [nir]\n", 'without: there is no spectrum "nir"'),
        ("max_steps: 1\nmax_steps: 2\n", "cannot be read as YAML"),
        ("a: [1\n", "cannot be read as YAML"),
        ("- 1\n", "must hold keys and values"),
        ("base: 7\n", "base must be the name of a preset"),
        ("base: mine.yaml\n", "is its own base"),
        ("base: 3dsg\n", 'neither a preset nor a YAML file (did you mean "3dgs"?)'),
        ("sh_degree: 5\n", "sh_degree must be at most 4, found 5"),
    ],
)
def test_mistake_names_file_and_key(text: str, expected: str, tmp_path: Path) -> None:
    """A mistake in a file is one sentence with the file, the key and, for a typo, the nearest key."""
    path = write(tmp_path, text)
    with pytest.raises(UserError) as caught:
        load_config(path)
    assert expected in caught.value.message
    assert "mine.yaml" in caught.value.message or "3dsg" in caught.value.message


def test_missing_file_and_unknown_preset() -> None:
    """A path that is not there and a name that is no preset are told apart; both list the presets."""
    for name, expected in [("nowhere/x.yaml", "no configuration file nowhere/x.yaml"), ("dmeo", 'did you mean "demo"')]:
        with pytest.raises(UserError, match=expected) as caught:
            load_config(name)
        assert "thermosplat" in caught.value.hint


def test_captures_are_named_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run keeps an absolute path, of ~ in a YAML file too; the capture in the package keeps its name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/of/mine")
    assert data_from_anywhere("shed") == str(tmp_path / "shed")
    assert data_from_anywhere("~/shed") == "/home/of/mine/shed"
    assert data_from_anywhere("sample") == "sample"
