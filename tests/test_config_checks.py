"""Ranges of configuration values, and settings that exclude each other."""

from dataclasses import Field, fields, is_dataclass, replace
from typing import Any

import pytest

from thermosplat.config import TrainConfig
from thermosplat.config_checks import check_config
from thermosplat.config_files import load_config
from thermosplat.errors import UserError


def fields_of(group: Any) -> tuple[Field[Any], ...]:
    return fields(group) if is_dataclass(group) else ()


def changed(key: str, value: Any) -> TrainConfig:
    config = TrainConfig()
    group, _, field = key.rpartition(".")
    if not group:
        return replace(config, **{field: value})
    return replace(config, **{group: replace(getattr(config, group), **{field: value})})


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("max_steps", 0, "--max-steps must be at least 1, found 0"),
        ("data_factor", 0, "--data-factor must be at least 1"),
        ("test_every", 1, "--test-every must be at least 2"),
        ("sh_degree", 4, "--sh-degree must be at most 3"),
        ("loss.ssim_lambda", 1.5, "--loss.ssim-lambda must lie between 0 and 1"),
        ("loss.depth_spread_from", 2.0, "--loss.depth-spread-from must lie between 0 and 1"),
        ("loss.thermal", -1.0, "--loss.thermal must be zero or positive"),
        ("optimizer.means_lr", float("nan"), "--optimizer.means-lr must be finite, found nan"),
        ("optimizer.means_lr", -1e-4, "--optimizer.means-lr must be zero or positive"),
        ("densification.growth", float("nan"), "--densification.growth must be finite, found nan"),
        ("thermal.range_celsius", (0.0, float("inf")), "--thermal.range-celsius must be finite, found inf"),
        ("densification.grad_threshold", -1.0, "--densification.grad-threshold must be at least 0"),
        ("seed", 2**63, "--seed must be at most 9223372036854775807"),
        ("eval_steps", (500, 0), "--eval-steps must be steps from 1 on, found [500, 0]"),
        ("optimizer.decoders_lr_final", 0.0, "--optimizer.decoders-lr-final must be positive"),
        ("model.init_opacity", 1.0, "--model.init-opacity must lie between 0 and 1"),
        ("model.feature_dim", 2, "--model.feature-dim must be 0 or at least 4"),
        ("model.gaussian_sets", "separate", "Separate Gaussians have no shared features"),
        ("background", (0.0, 2.0, 0.0), "--background must be three values between 0 and 1"),
        ("thermal.range_celsius", (30.0, 20.0), "--thermal.range-celsius must rise"),
        ("densification.max_gaussians", 0, "--densification.max-gaussians must be at least 1"),
        ("auto_budget.prune_at", (0.5, 1.0), "--auto-budget.prune-at must be shares of the run between 0 and 1"),
        ("auto_budget.prune_change", -1.0, "--auto-budget.prune-change must be at least 0"),
        ("auto_budget.feature_change", -1.0, "--auto-budget.feature-change must be at least 0"),
        ("densification.reset_opacity", 0.0, "--densification.reset-opacity must lie between 0 and 1"),
        ("densification.reset_opacity", 1.0, "--densification.reset-opacity must lie between 0 and 1"),
        ("densification.strategy", "mcmc", "mcmc grows to a budget, and there is none"),
        ("densification.growth", -0.1, "--densification.growth must be at least 0"),
        ("densification.decompose_threshold", 2e-4, "needs a shared set with a thermal opacity of its own"),
        ("densification.off_opacity", 0.01, "--densification.off-opacity must lie between 0 and 1/255"),
        ("densification.keep_opacity", 2.0, "--densification.keep-opacity must lie between 0 and 1"),
        ("schedule.thermal_from", 1.5, "--schedule.thermal-from must lie between 0 and 1"),
        ("loss.balance", True, "--loss.balance is about two separate sets of Gaussians"),
        ("model.thermal_start", "rgb", "--model.thermal-start is about two separate sets of Gaussians"),
        ("decoder.branches", "separate", "leaves nothing to modulate one spectrum by the other with"),
    ],
)
def test_impossible_value_is_named(key: str, value: Any, expected: str) -> None:
    """A value that no run can work with is refused with its flag and what was expected."""
    with pytest.raises(UserError) as caught:
        check_config(changed(key, value))
    assert expected in caught.value.message


def test_no_number_may_be_without_an_end() -> None:
    """Every field of a fractional number refuses infinity, whichever group it is in."""
    config = TrainConfig()
    fields = [("", field) for field in fields_of(config)]
    fields += [(group.name, field) for group in fields_of(config) for field in fields_of(getattr(config, group.name))]
    numbers = [".".join(filter(None, (group, field.name))) for group, field in fields if field.type is float]
    assert len(numbers) > 40
    for key in numbers:
        with pytest.raises(UserError, match="must be finite"):
            check_config(changed(key, float("inf")))


def test_nothing_to_train() -> None:
    """A model of neither spectrum is refused."""
    config = changed("model.rgb", False)
    with pytest.raises(UserError, match="both off"):
        check_config(replace(config, model=replace(config.model, thermal=False)))


def test_depths_are_blended_with_features() -> None:
    """A penalty on their spread where there are no features is refused, and says why."""
    config = changed("loss.depth_spread", 0.1)
    check_config(config)
    with pytest.raises(UserError, match=r"--loss\.depth-spread is 0\.1, but depths are blended with features"):
        check_config(replace(config, model=replace(config.model, feature_dim=0)))


def test_schedule_must_leave_something_to_train() -> None:
    """A gap between the spectra, or a schedule of two spectra where one is modelled, is refused."""
    gap = changed("schedule.rgb_until", 0.3)
    with pytest.raises(UserError, match="there is nothing to train on"):
        check_config(replace(gap, schedule=replace(gap.schedule, thermal_from=0.6)))
    thermal_alone = changed("model.rgb", False)
    with pytest.raises(UserError, match="only one is modelled"):
        check_config(replace(thermal_alone, schedule=replace(thermal_alone.schedule, thermal_from=0.5)))


def test_decomposition_needs_directions() -> None:
    """Absolute gradients have no direction in which the spectra could differ."""
    config = load_config("mmone")
    with pytest.raises(UserError, match="compares directions"):
        check_config(replace(config, densification=replace(config.densification, absgrad=True)))


def test_file_is_named_in_place_of_flags() -> None:
    """Values from a file are reported with the file and the key as it is written there."""
    with pytest.raises(UserError) as caught:
        check_config(changed("max_steps", 0), source="my.yaml")
    assert caught.value.message.startswith("my.yaml: max_steps must")


def test_thermal_gaussians_start_from_trained_ones() -> None:
    """A copy of the RGB set before its first step would never be made; from the first step on it is."""
    config = load_config("thermalgaussian_mftg")
    for share, steps in ((0.0, 60_000), (0.004, 100)):
        early = replace(config, max_steps=steps, schedule=replace(config.schedule, thermal_from=share))
        expected = rf"--model\.thermal-start rgb copies .* --schedule\.thermal-from {share} of {steps} steps"
        with pytest.raises(UserError, match=expected):
            check_config(early)
    check_config(replace(config, max_steps=100, schedule=replace(config.schedule, thermal_from=0.01)))


def test_features_may_be_many() -> None:
    """The renderer blends any number of channels, in several traversals."""
    check_config(changed("model.feature_dim", 500))


def test_default_is_valid() -> None:
    """The schema's defaults pass."""
    check_config(TrainConfig())
