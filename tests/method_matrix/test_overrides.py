"""Settings on the command line that differ from the presets."""

import dataclasses

import pytest

from thermosplat.config.files import load_config
from thermosplat.errors import UserError
from thermosplat.method_matrix.cells import Cell
from thermosplat.method_matrix.overrides import parse_overrides

METHODS = ("3dgs", "mmone")
SCENES = ("lab", "desk")


def test_settings_of_one_method_and_of_all() -> None:
    """Fields of groups with a dot, numbers as YAML has them, texts as they are."""
    one, every, small = parse_overrides(
        ["3dgs:densification.max_gaussians=150000", "rasterize_mode_is=x", "optimizer.quats_lr=1e-8"], SCENES, METHODS
    )
    assert (one.cells, every.cells) == ("3dgs", "")
    config = one.applied(load_config("3dgs"))
    assert config.densification.max_gaussians == 150_000
    assert config.densification.grad_threshold == load_config("3dgs").densification.grad_threshold
    assert small.applied(config).optimizer.quats_lr == 1e-8
    with pytest.raises(UserError, match='--set rasterize_mode_is=x: unknown key "rasterize_mode_is"'):
        every.applied(config)


def test_settings_of_a_spectrum() -> None:
    """By the spectrum's name; other spectra, and its other settings, stay."""
    config = load_config("thermosplat")
    words = ["spectra.thermal.loss=0.5", "spectra.nir.opacity=own", "without=[thermal]"]
    new, added, left_out = (override.applied(config) for override in parse_overrides(words, SCENES, METHODS))
    assert new.spectra["thermal"] == dataclasses.replace(config.spectra["thermal"], loss=0.5)
    assert new.spectra["rgb"] == config.spectra["rgb"]
    assert (list(added.spectra), added.spectra["nir"].opacity) == (["rgb", "thermal", "nir"], "own")
    assert list(left_out.modelled) == ["rgb"]


def test_steps_that_are_set_are_meant() -> None:
    """However many views a scene has."""
    (override,) = parse_overrides(["max_steps=5000"], SCENES, METHODS)
    changed = override.applied(load_config("thermosplat_plus"))
    assert (changed.max_steps, changed.steps_for_views) == (5000, None)


def test_which_cells_are_concerned() -> None:
    """Every one, those of a method or of a scene, or one."""
    cells = [Cell(scene, method, 1) for scene in SCENES for method in METHODS]
    words = ["sh_degree=1", "mmone:sh_degree=1", "desk:sh_degree=1", "desk/3dgs:sh_degree=1"]
    concerned = [[override.concerns(cell) for cell in cells] for override in parse_overrides(words, SCENES, METHODS)]
    assert concerned == [
        [True, True, True, True],
        [False, True, False, True],
        [False, False, True, True],
        [False, False, True, False],
    ]


def test_value_of_another_type_is_a_users_error() -> None:
    """The field and what it takes are named."""
    (override,) = parse_overrides(["densification.max_gaussians=many"], SCENES, METHODS)
    with pytest.raises(UserError, match=r"--set .*densification.max_gaussians.* a whole number"):
        override.applied(load_config("mmone"))


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("max_gaussians", r"\[CELLS:\]FIELD=VALUE, found max_gaussians"),
        ("=3", r"\[CELLS:\]FIELD=VALUE"),
        (":sh_degree=3", r"\[CELLS:\]FIELD=VALUE"),
        ("msplat:sh_degree=3", 'no cell of this matrix is called "msplat"'),
        ("seed=3", "seed is not a setting of a method"),
        ("eval_steps=[5]", "eval_steps is not a setting"),
        ("spectra.rgb={", "cannot be read"),
    ],
)
def test_mistakes_name_the_word_that_is_wrong(word: str, expected: str) -> None:
    """Every one says what is wrong with which word, and what to do."""
    with pytest.raises(UserError, match=expected) as caught:
        parse_overrides([word], SCENES, METHODS)
    assert caught.value.hint
