"""Steps of several frames see the images of as many steps of one; a scaler and many views change every schedule."""

import dataclasses
import math

import pytest

from thermosplat.config import OptimizerConfig, TrainConfig
from thermosplat.config.run_schedule import adam_betas, run_schedule, scaled_steps, steps_note


def test_one_frame_per_step_and_no_scaler_change_nothing() -> None:
    """Not even the object."""
    for size in (None, 1):
        config = TrainConfig(batch_size=size)
        assert run_schedule(config) is config
    assert adam_betas(1) == (0.9, 0.999)


def test_schedules_count_images_and_rates_follow_the_root() -> None:
    """Every number of steps is divided, rounded up; rates and decay, and no other setting of Adam, take √B."""
    optimizer = OptimizerConfig(shN_decay=4.0)
    config = TrainConfig(batch_size=4, max_steps=30_001, save_steps=(2, 7000), optimizer=optimizer)
    scaled = run_schedule(config)
    assert scaled.max_steps == 7501
    assert scaled.save_steps == (1, 1750)
    assert scaled.densification.every == 25
    assert scaled.densification.stop_step == 3750
    assert scaled.refine_from == 125
    assert scaled.refine_every == 2
    assert scaled.refine_first == 150
    assert scaled.refine_rounds_from == 21
    assert scaled.auto_budget.validate_every == 63
    assert scaled.log_every == config.log_every
    unscaled = ("final_share", "cooldown_from")
    for field in dataclasses.fields(config.optimizer):
        before, after = getattr(config.optimizer, field.name), getattr(scaled.optimizer, field.name)
        assert after == (before if field.name in unscaled else 2 * before), field.name
    assert adam_betas(4) == (0.9**4, 0.999**4)
    assert scaled_steps(9, 1 / 4) == 3


@pytest.mark.parametrize("batch_size", [1, 2])
def test_a_scaler_shortens_all_schedules(batch_size: int) -> None:
    """Those of the scene, each by the same; not the search for cameras before it, and no rates."""
    config = TrainConfig(steps_scaler=0.3, batch_size=batch_size, save_steps=(7000,))
    scaled, batches = run_schedule(config), run_schedule(TrainConfig(batch_size=batch_size))
    assert scaled.max_steps == 9000 / batch_size
    assert scaled.sh_degree_interval == 300 / batch_size
    assert scaled.save_steps == (2100 / batch_size,)
    assert scaled.refine_from == 150 / batch_size
    densification, budget = scaled.densification, scaled.auto_budget
    assert (densification.start_step, densification.stop_step) == (150 / batch_size, 4500 / batch_size)
    assert (densification.every, densification.reset_every) == (30 / batch_size, 900 / batch_size)
    assert budget.validate_every == math.ceil(75 / batch_size)
    cameras = ("refine_first", "refine_every", "refine_rounds_from", "log_every")
    assert [getattr(scaled, name) for name in cameras] == [getattr(batches, name) for name in cameras]
    assert scaled.optimizer == batches.optimizer


def test_numbers_that_binary_fractions_miss_are_not_rounded_up() -> None:
    """30 times 1.1 is 33.000000000000004 in floats."""
    assert scaled_steps(30, 1.1) == 33
    assert scaled_steps(7, 0.1) == 1


@pytest.mark.parametrize(
    ("views", "steps"), [(0, 9000), (1, 9000), (45, 9000), (46, 9200), (100, 20_000), (150, 30_000), (9999, 30_000)]
)
def test_more_views_ask_for_more_steps(views: int, steps: int) -> None:
    """Each is seen as often, up to 30,000 steps; all schedules keep their shares, and the user is told."""
    config = TrainConfig(max_steps=9000, steps_for_views=45, save_steps=(4500,))
    scaled = run_schedule(config, views)
    assert scaled.max_steps == steps
    assert scaled.save_steps == (steps / 2,)
    assert scaled.densification.stop_step == math.ceil(15_000 * steps / 9000)
    assert bool(steps_note(config, views, ())) == (steps > 9000)
    assert run_schedule(TrainConfig(max_steps=9000), views).max_steps == 9000


def test_views_count_beside_scaler_and_batches() -> None:
    """90 views double the steps, a scaler of a half halves them, and steps of three frames are a third of both."""
    config = TrainConfig(max_steps=9000, steps_for_views=45, steps_scaler=0.5, batch_size=3)
    assert run_schedule(config, 90).max_steps == 3000
    (note,) = steps_note(config, 90, ())
    assert note.startswith("90 training views, more than 45: 9,000 steps of one frame in place of 4,500 (")


def test_what_was_scaled_is_not_scaled_again() -> None:
    """The result is the schedule as it is run."""
    config = TrainConfig(max_steps=9000, steps_for_views=45, steps_scaler=0.5, noisy_steps=1.5)
    scaled = run_schedule(config, 90, ("rgb",))
    assert (scaled.max_steps, scaled.steps_scaler, scaled.steps_for_views) == (13_500, 1.0, None)
    assert run_schedule(scaled, 90, ("rgb",)) is scaled


@pytest.mark.parametrize(
    ("views", "noisy", "steps", "why"),
    [
        (45, ("rgb",), 9000, "Noisy RGB images"),
        (90, (), 12_000, "90 training views, more than 45"),
        (90, ("rgb", "thermal"), 18_000, "90 training views, more than 45, and noisy RGB and thermal images"),
        (999, ("thermal",), 30_000, "999 training views, more than 45, and noisy thermal images"),
    ],
)
def test_noise_asks_for_more_steps(views: int, noisy: tuple[str, ...], steps: int, why: str) -> None:
    """So many times those that the views ask for, up to the longest; the user is told why."""
    config = TrainConfig(max_steps=6000, steps_for_views=45, noisy_steps=1.5)
    assert run_schedule(config, views, noisy).max_steps == steps
    (note,) = steps_note(config, views, noisy)
    assert note.startswith(f"{why}: {steps:,} steps of one frame in place of 6,000 (")


def test_noise_changes_no_schedule_that_does_not_say_so() -> None:
    """Nor one that is as long as any."""
    for config in (TrainConfig(max_steps=6000), TrainConfig(max_steps=30_000, noisy_steps=1.5)):
        assert run_schedule(config, 45, ("rgb",)) is config
        assert steps_note(config, 45, ("rgb",)) == ()


def test_a_schedule_longer_than_the_longest_stays() -> None:
    """More views never shorten one."""
    config = TrainConfig(max_steps=40_000, steps_for_views=45)
    assert run_schedule(config, 90) is config
