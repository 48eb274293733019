"""Steps of several frames see the images of as many steps of one; a scaler shortens every schedule."""

import dataclasses
import math

import pytest

from thermosplat.config import OptimizerConfig, TrainConfig
from thermosplat.config.run_schedule import adam_betas, run_schedule, scaled_steps


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
    assert scaled.auto_budget.patience == 750
    assert scaled.log_every == config.log_every
    for field in dataclasses.fields(config.optimizer):
        before, after = getattr(config.optimizer, field.name), getattr(scaled.optimizer, field.name)
        assert after == (before if field.name in ("eps", "final_share") else 2 * before), field.name
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
    assert (budget.patience, budget.validate_every) == (900 / batch_size, math.ceil(75 / batch_size))
    cameras = ("refine_first", "refine_every", "refine_rounds_from", "log_every")
    assert [getattr(scaled, name) for name in cameras] == [getattr(batches, name) for name in cameras]
    assert scaled.optimizer == batches.optimizer


def test_numbers_that_binary_fractions_miss_are_not_rounded_up() -> None:
    """30 times 1.1 is 33.000000000000004 in floats."""
    assert scaled_steps(30, 1.1) == 33
    assert scaled_steps(7, 0.1) == 1
