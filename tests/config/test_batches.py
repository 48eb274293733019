"""Steps of several frames see the images of as many steps of one."""

import dataclasses
import math

from thermosplat.config import OptimizerConfig, TrainConfig
from thermosplat.config.batches import adam_betas, in_batches, steps_of_batches


def test_a_batch_of_one_changes_nothing() -> None:
    """Not even the object."""
    for size in (None, 1):
        config = TrainConfig(batch_size=size)
        assert in_batches(config) is config
    assert adam_betas(1) == (0.9, 0.999)


def test_schedules_count_images_and_rates_follow_the_root() -> None:
    """Every number of steps is divided, rounded up; rates and decay, and no other setting of Adam, take √B."""
    optimizer = OptimizerConfig(shN_decay=4.0)
    config = TrainConfig(batch_size=4, max_steps=30_001, save_steps=(2, 7000), optimizer=optimizer)
    scaled = in_batches(config)
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
    assert steps_of_batches(math.ceil(9), 4) == 3
