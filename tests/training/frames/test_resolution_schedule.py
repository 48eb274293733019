"""Which step has images of which size, and how many Gaussians it may have."""

import dataclasses

import pytest

from thermosplat.config import ResolutionConfig, TrainConfig
from thermosplat.config.run_schedule import run_schedule
from thermosplat.training.frames.resolution_schedule import image_factor, most_gaussians, resolution_note
from toy_run import toy_run_config

GROWING = ResolutionConfig(factors=(4, 2.5), until=(0.2, 0.65), growth_power=2.0)


def config_of(max_steps: int = 20, **changes: object) -> TrainConfig:
    return toy_run_config(max_steps, resolution=GROWING, **changes)


def test_sizes_follow_each_other() -> None:
    """A fifth of the run at a quarter of the size, then to 65% at 1 / 2.5, then full size to the end."""
    factors = [image_factor(config_of(), step) for step in range(1, 21)]
    assert factors == [4.0] * 4 + [2.5] * 9 + [1.0] * 7


def test_shares_follow_the_length_of_the_run() -> None:
    """They are shares of what the run has in all; in batches of four, a step counts as four."""
    assert [image_factor(config_of(40), step) for step in (8, 9, 26, 27)] == [4.0, 2.5, 2.5, 1.0]
    batches = run_schedule(config_of(80, batch_size=4))
    assert [image_factor(batches, step) for step in (4, 5, 13, 14, 20)] == [4.0, 2.5, 2.5, 1.0, 1.0]


def test_without_factors_all_steps_have_full_size() -> None:
    """The default changes nothing, and says nothing."""
    config = toy_run_config(5)
    assert {image_factor(config, step) for step in range(1, 6)} == {1.0}
    assert resolution_note(config) == ()


@pytest.mark.parametrize(("most", "expected"), [(None, [None] * 3), (600, [37, 96, 600]), (3, [1, 1, 3])])
def test_gaussians_grow_with_the_pixels(most: int | None, expected: list[int | None]) -> None:
    """As many to a pixel as at the end, at least one; without a limit there is none."""
    config = config_of()
    config = dataclasses.replace(config, densification=dataclasses.replace(config.densification, max_gaussians=most))
    assert [most_gaussians(config, factor) for factor in (4.0, 2.5, 1.0)] == expected


@pytest.mark.parametrize(("power", "expected"), [(0.0, [600] * 3), (1.0, [150, 240, 600])])
def test_growth_may_be_ahead_of_the_pixels(power: float, expected: list[int]) -> None:
    """With the sides of images, or not bounded by them at all."""
    config = dataclasses.replace(config_of(), resolution=dataclasses.replace(GROWING, growth_power=power))
    assert [most_gaussians(config, factor) for factor in (4.0, 2.5, 1.0)] == expected


def test_the_user_is_told() -> None:
    """One line with the steps at which sizes change."""
    (line,) = resolution_note(config_of(2000))
    assert "divided by 4 up to step 400, divided by 2.5 up to step 1,300, then of full size." in line
