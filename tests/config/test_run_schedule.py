"""Steps of several frames see the images of as many steps of one; a scaler and many views change every schedule."""

import dataclasses
import math

import pytest

from thermosplat.config import DensificationConfig, OptimizerConfig, TrainConfig
from thermosplat.config.files import load_config
from thermosplat.config.run_schedule import adam_betas, in_steps, run_schedule, scaled_steps, steps_note

PRESETS_IN_STEPS = {
    "thermosplat": (1000, 500, 500, 15_000, 100, 3000, 250),
    "thermosplat_plus": (600, 250, 130, 4800, 35, 600, 170),
    "thermosplat_fast": (400, 167, 133, 3200, 33, 400, 113),
    "demo": (170, 40, 40, 440, 20, 680, 250),
    "3dgs": (1000, 500, 500, 15_000, 100, 3000, 250),
    "ms_splatting": (1000, 500, 500, 45_000, 300, 9000, 250),
    "thermalgaussian_mftg": (1000, 500, 500, 15_000, 100, 3000, 250),
}


def schedule(config: TrainConfig) -> tuple[float, ...]:
    """All that may be steps or a share of the run."""
    density = config.densification
    of_density = (density.start_step, density.stop_step, density.every, density.reset_every)
    return config.sh_degree_interval, config.refine_from, *of_density, config.auto_budget.validate_every


@pytest.mark.parametrize("preset", PRESETS_IN_STEPS)
def test_presets_have_shares_that_are_published_steps(preset: str) -> None:
    """And nothing of theirs is given in steps, so that another number of them has the same course."""
    config = load_config(preset)
    assert all(isinstance(share, float) for share in schedule(config))
    assert schedule(in_steps(config)) == PRESETS_IN_STEPS[preset]
    twice = in_steps(dataclasses.replace(config, max_steps=2 * config.max_steps))
    assert schedule(twice) == pytest.approx([2 * steps for steps in PRESETS_IN_STEPS[preset]], abs=1)


def test_steps_that_are_given_stay() -> None:
    """Whatever the length of the run; a share is a step at least, but for none at all."""
    density = DensificationConfig(start_step=0, stop_step=7, every=0.001, reset_every=1.0)
    found = in_steps(TrainConfig(max_steps=90, densification=density)).densification
    assert (found.start_step, found.stop_step, found.every, found.reset_every) == (0, 7, 1, 90)
    assert in_steps(TrainConfig(densification=DensificationConfig(stop_step=0.0))).densification.stop_step == 0
    assert in_steps(TrainConfig(max_steps=90), 30_000).densification == in_steps(TrainConfig()).densification


def test_one_frame_per_step_and_no_scaler_change_nothing() -> None:
    """Not even the object."""
    for size in (None, 1):
        config = in_steps(TrainConfig(batch_size=size))
        assert run_schedule(config) is config
    assert adam_betas(1) == (0.9, 0.999)


def test_schedules_count_images_and_rates_follow_the_root() -> None:
    """Every number of steps is divided, rounded up; rates and decay, and no other setting of Adam, take √B."""
    optimizer = OptimizerConfig(shN_decay=4.0)
    config = TrainConfig(batch_size=4, max_steps=30_000, save_steps=(2, 7000), optimizer=optimizer)
    scaled = run_schedule(config)
    assert scaled.max_steps == 7500
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
    assert scaled.densification.stop_step == steps / 2
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
    for shares in (TrainConfig(max_steps=6000), TrainConfig(max_steps=30_000, noisy_steps=1.5)):
        config = in_steps(shares)
        assert run_schedule(config, 45, ("rgb",)) is config
        assert steps_note(config, 45, ("rgb",)) == ()


def test_a_schedule_longer_than_the_longest_stays() -> None:
    """More views never shorten one."""
    config = in_steps(TrainConfig(max_steps=40_000, steps_for_views=45))
    assert run_schedule(config, 90) is config
