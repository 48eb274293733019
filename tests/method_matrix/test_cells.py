"""Which cells there are, and what each is configured to do."""

import dataclasses
from pathlib import Path

import pytest

from thermosplat.config.files import load_config, preset_paths
from thermosplat.errors import UserError
from thermosplat.method_matrix.cells import (
    Cell,
    Scene,
    cell_config,
    difference,
    method_group,
    parse_methods,
    parse_scenes,
    settings,
)

SAMPLE = Scene("sample", "sample")


def test_scenes_of_a_command_line(tmp_path: Path) -> None:
    """Folders go by their names or by those they are given."""
    (tmp_path / "shed").mkdir()
    scenes = parse_scenes(["sample", str(tmp_path / "shed"), f"barn={tmp_path / 'shed'}"])
    assert [scene.name for scene in scenes] == ["sample", "shed", "barn"]
    assert scenes[1].data == scenes[2].data == str((tmp_path / "shed").resolve())


def test_wrong_scenes_are_users_errors(tmp_path: Path) -> None:
    """A folder that is not there, and two scenes of one name."""
    with pytest.raises(UserError, match="no capture folder nowhere"):
        parse_scenes(["nowhere"])
    with pytest.raises(UserError, match="Two scenes are called a"):
        parse_scenes([f"a={tmp_path}", "a=sample"])


def test_methods_of_a_command_line(tmp_path: Path) -> None:
    """Groups are their folders' presets, files go by their stems, and everything comes once."""
    mine = tmp_path / "mine.yaml"
    mine.write_text("base: mmone\n")
    methods = parse_methods(["baselines", "thermosplat", "3dgs", str(mine)])
    group = {name for name, path in preset_paths().items() if path.parent.name == "baselines"}
    assert set(methods) == group | {"thermosplat", "mine"}
    assert methods["mine"] == str(mine)
    with pytest.raises(UserError, match='did you mean "mmone"'):
        parse_methods(["mmon"])


def test_methods_and_scenes_keep_their_names_apart(tmp_path: Path) -> None:
    """A file does not quietly take the place of a preset or of another file; a folder may have "=" in its name."""
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.yaml").write_text("base: 3dgs\n")
        (tmp_path / folder / "3dgs.yaml").write_text("base: thermosplat\n")
    mine = str(tmp_path / "a" / "mine.yaml")
    assert parse_methods([mine, mine]) == {"mine": mine}
    for words in ([mine, str(tmp_path / "b" / "mine.yaml")], ["baselines", str(tmp_path / "a" / "3dgs.yaml")]):
        with pytest.raises(UserError, match="Two methods are called"):
            parse_methods(words)
    (tmp_path / "f=2").mkdir()
    assert [scene.name for scene in parse_scenes([str(tmp_path / "f=2")])] == ["f=2"]


def test_shorter_matrix_keeps_proportions() -> None:
    """A method of 60,000 steps gets twice the steps of one of 30,000, and its phases move along."""
    short = {name: cell_config(name, SAMPLE, 1, max_steps=300) for name in ("3dgs", "thermalgaussian_mftg")}
    assert [config.max_steps for config in short.values()] == [300, 600]
    assert short["thermalgaussian_mftg"].spectra["thermal"].train_from == 0.5
    assert cell_config("thermalgaussian_mftg", SAMPLE, 1).max_steps == 60_000
    ours = cell_config("thermosplat_plus", SAMPLE, 1, max_steps=3000)
    assert (ours.max_steps, ours.steps_for_views) == (600, None)
    assert cell_config("thermosplat_plus", SAMPLE, 1).steps_for_views == 45


def test_groups_of_methods() -> None:
    """By the folder of the preset; a file of the user's is in none."""
    assert [method_group(name) for name in ("mmone", "mlp_based", "mine")] == ["baselines", "ablations", ""]
    assert method_group("thermosplat") not in ("baselines", "ablations")


def test_held_out_views_are_left_to_the_end() -> None:
    """No evaluation on the way; checkpoints as asked for; the other settings are the preset's."""
    config = cell_config("mmone", SAMPLE, 7, max_steps=100, save_every=40, data_factor=2)
    assert (config.eval_steps, config.save_steps) == ((), (40, 80))
    assert (config.seed, config.data, config.data_factor) == (7, "sample", 2)
    assert config.loss == load_config("mmone").loss


def test_settings_are_what_is_computed() -> None:
    """Where and how a cell is computed does not make it another one; what is computed does, and is named."""
    config = cell_config("mmone", SAMPLE, 7, max_steps=100)
    elsewhere = cell_config("mmone", Scene("sample", "/elsewhere"), 7, max_steps=100, save_every=5, device="cpu")
    assert difference(settings(config), settings(elsewhere)) == ""
    longer = cell_config("mmone", SAMPLE, 7, max_steps=200)
    assert difference(settings(config), settings(longer)) == "max_steps=100, now 200"
    assert difference(settings(config), settings(cell_config("3dgs", SAMPLE, 7, max_steps=100))).startswith("spectra.")


def test_a_spectrum_more_makes_another_cell(tmp_path: Path) -> None:
    """The list of spectra, and what is left out of it, is a setting."""
    (tmp_path / "nir.yaml").write_text("base: thermosplat\nspectra:\n  nir: {}\n")
    two, three = (cell_config(name, SAMPLE, 7) for name in ("thermosplat", str(tmp_path / "nir.yaml")))
    assert difference(settings(two), settings(three)).startswith("spectra.nir=None, now {")
    left_out = dataclasses.replace(two, without=("thermal",))
    assert difference(settings(two), settings(left_out)) == "without=[], now ['thermal']"


def test_folder_of_a_cell() -> None:
    """Scene, method and seed find the run."""
    assert Cell("lab", "mmone", 3).folder(Path("out")) == Path("out/lab/mmone/seed_3")
