"""Ranges of configuration values, and settings that exclude each other."""

import re
from dataclasses import Field, fields, is_dataclass, replace
from typing import Any

import pytest

from thermosplat.config import ResolutionConfig, TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.config.files import load_config
from thermosplat.errors import UserError
from toy_scene import with_spectra


def fields_of(group: Any) -> tuple[Field[Any], ...]:
    return fields(group) if is_dataclass(group) else ()


def changed(key: str, value: Any, config: TrainConfig | None = None) -> TrainConfig:
    config = config or TrainConfig()
    group, _, field = key.rpartition(".")
    if not group:
        return replace(config, **{field: value})
    if group.startswith("spectra."):
        return with_spectra(config, **{group.removeprefix("spectra."): {field: value}})
    return replace(config, **{group: replace(getattr(config, group), **{field: value})})


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("max_steps", 0, "--max-steps must be at least 1, found 0"),
        ("data_factor", 0, "--data-factor must be at least 1"),
        ("test_every", 1, "--test-every must be at least 2"),
        ("sh_degree", 5, "--sh-degree must be at most 4"),
        ("loss.ssim_lambda", 1.5, "--loss.ssim-lambda must lie between 0 and 1"),
        ("spectra.thermal.swept_depth", -1.0, "--thermal.swept-depth must be zero or positive"),
        ("spectra.thermal.point_spread", -1.0, "--thermal.point-spread must be zero or positive"),
        ("spectra.thermal.loss", -1.0, "--thermal.loss must be zero or positive"),
        ("optimizer.means_lr", float("nan"), "--optimizer.means-lr must be finite, found nan"),
        ("optimizer.means_lr", -1e-4, "--optimizer.means-lr must be zero or positive"),
        ("densification.growth", float("nan"), "--densification.growth must be finite, found nan"),
        ("densification.split_apart", 0.9, "--densification.split-apart must be at most 0.8, found 0.9"),
        ("spectra.thermal.range", (0.0, float("inf")), "--thermal.range must be finite, found inf"),
        ("densification.grad_threshold", -1.0, "--densification.grad-threshold must be at least 0"),
        ("seed", 2**63, "--seed must be at most 9223372036854775807"),
        ("eval_steps", (500, 0), "--eval-steps must be steps from 1 on, found [500, 0]"),
        ("optimizer.decoders_lr_final", 0.0, "--optimizer.decoders-lr-final must be positive"),
        ("model.init_opacity", 1.0, "--model.init-opacity must lie between 0 and 1"),
        ("model.feature_dim", 2, "--model.feature-dim must be 0 or at least 4"),
        ("model.gaussian_sets", "separate", "Separate Gaussians have no shared features"),
        ("steps_scaler", 0.0, "--steps-scaler must be positive"),
        ("background", (0.0, 2.0, 0.0), "--background must be three values between 0 and 1"),
        (
            "spectra.thermal.range",
            (30.0, 20.0),
            "--thermal.range must rise from the lowest to the highest value, found",
        ),
        ("densification.max_gaussians", 0, "--densification.max-gaussians must be at least 1"),
        ("auto_budget.prune_at", (0.5, 1.0), "--auto-budget.prune-at must be shares of the run between 0 and 1"),
        ("resolution.growth_power", -1.0, "--resolution.growth-power must be at least 0"),
        ("resolution.factors", (2.0,), "one share of the run for each factor, found 1 and 0"),
        ("auto_budget.validate_every", 0, "--auto-budget.validate-every must be at least 1 as steps"),
        (
            "densification.every",
            0.0,
            "--densification.every must be at least 1 as steps, which are a whole number, or be",
        ),
        ("densification.stop_step", 15000.0, "between 0 and 1 as a share of the run, found 15000.0"),
        ("densification.start_step", -1, "--densification.start-step must be at least 0 as steps"),
        ("refine_from", -0.5, "--refine-from must be at least 0 as steps"),
        ("densification.prune_opacity", 0.0, "--densification.prune-opacity must lie between 0 and 0.5"),
        ("densification.prune_opacity", 0.5, "--densification.prune-opacity must lie between 0 and 0.5"),
        ("densification.growth", -0.1, "--densification.growth must be at least 0"),
        ("decoder.fourier_frequency", -3.0, "--decoder.fourier-frequency must be at least 0"),
        (
            "densification.strategy",
            "decomposing",
            "needs a shared set of at least two, each with an opacity of its",
        ),
        ("spectra.thermal.train_from", 1.5, "--thermal.train-from must lie between 0 and 1"),
        ("loss.balance", True, "--loss.balance is about separate sets of Gaussians, one per spectrum"),
        (
            "spectra.thermal.start",
            "rgb",
            "--thermal.start rgb copies one set of Gaussians to another, which needs separate",
        ),
        ("decoder.branches", "separate", "leaves nothing to modulate one spectrum by the other with"),
    ],
)
def test_impossible_value_is_named(key: str, value: Any, expected: str) -> None:
    """A value that no run can work with is refused with its flag and what was expected."""
    with pytest.raises(UserError) as caught:
        check_config(changed(key, value))
    assert expected in caught.value.message


@pytest.mark.parametrize("value", [float("inf"), float("nan"), 1e308, -1e308, 1e39, 1e-320])
def test_no_number_may_leave_the_range_of_what_is_computed(value: float) -> None:
    """Every field of a fractional number refuses what float32 does not hold, whichever group it is in."""
    config = TrainConfig()
    groups = {group.name: getattr(config, group.name) for group in fields_of(config)}
    groups |= {f"spectra.{name}": spectrum for name, spectrum in config.spectra.items()}
    fields = [("", field) for field in fields_of(config)]
    fields += [(name, field) for name, group in groups.items() for field in fields_of(group)]
    numbers = [".".join(filter(None, (group, field.name))) for group, field in fields if field.type is float]
    assert len(numbers) > 40
    assert {"spectra.rgb.factor", "spectra.thermal.squared"} <= set(numbers)
    for key in numbers:
        with pytest.raises(UserError, match="must be") as caught:
            check_config(changed(key, value))
        assert f"found {value}" in caught.value.message
    check_config(changed("optimizer.means_lr", 0.0))


@pytest.mark.parametrize("key", ["max_steps", "log_every", "model.feature_dim", "densification.every", "save_steps"])
@pytest.mark.parametrize("value", [10**13, 2**63, 10**400])
def test_whole_numbers_have_an_end(key: str, value: int) -> None:
    """Sums and products of what is allowed can be computed."""
    with pytest.raises(UserError, match="must be at most"):
        check_config(changed(key, (value,) if key == "save_steps" else value))


@pytest.mark.parametrize("key", ["data", "result_dir", "lpips_weights", "resume", "spectra.thermal.palette"])
@pytest.mark.parametrize(("name", "why"), [("caf\udce9", "which is not UTF-8"), ("a${b", "can hold ${")])
def test_names_that_a_configuration_cannot_hold(key: str, name: str, why: str) -> None:
    """It is written as YAML, in UTF-8, and ${...} in it means something else."""
    with pytest.raises(UserError) as caught:
        check_config(changed(key, name))
    assert why in caught.value.message
    check_config(changed(key, "ünï 温度\n\x1b[2J"))


def test_latent_channels_of_the_modelled_spectra() -> None:
    """As few as the losses supervise; the message says which, a spectrum that is left out has none."""
    config = replace(TrainConfig(), model=replace(TrainConfig().model, feature_dim=3))
    with pytest.raises(UserError, match=r"losses supervise channels 0 to 2 with RGB, channel 3 with thermal\."):
        check_config(config)
    check_config(replace(config, without=("thermal",)))
    check_config(with_spectra(config, thermal={"features": None}))
    further = with_spectra(changed("model.feature_dim", 4), nir={})
    with pytest.raises(UserError, match=r"at least 5, found 4: .* channel 3 with thermal, channel 4 with NIR\."):
        check_config(further)
    check_config(with_spectra(further, nir={"features": None}))


def test_balance_of_one_set() -> None:
    """Separate sets have shares of all Gaussians only if there are several."""
    config = load_config("thermalgaussian_msmg")
    check_config(config)
    with pytest.raises(UserError, match=r"--loss\.balance is about separate sets"):
        check_config(replace(config, without=("thermal",)))


def test_decomposition_is_of_spectra_with_opacities_of_their_own() -> None:
    """A third one may have one, too; without it has no place among them, and does not disturb where it is left out."""
    check_config(with_spectra(load_config("mmone"), nir={"opacity": "own"}))
    config = with_spectra(load_config("mmone"), nir={"opacity": "shared"})
    with pytest.raises(UserError, match="decomposing divides Gaussians between spectra"):
        check_config(config)
    check_config(replace(config, without=("nir",)))


def test_what_needs_features() -> None:
    """Blended depths and blur where there are no features are refused, and the sentence says why."""
    config = changed("loss.depth_spread", 0.1)
    check_config(config)
    with pytest.raises(UserError, match=r"--loss\.depth-spread is 0\.1, but depths are blended with features"):
        check_config(replace(config, model=replace(config.model, feature_dim=0)))
    for field, flag, why in (
        ("swept_depth", "swept-depth", "depths are blended"),
        ("point_spread", "point-spread", "blur is of features"),
    ):
        config = with_spectra(TrainConfig(), thermal={field: 0.1})
        check_config(config)
        with pytest.raises(UserError, match=rf"--thermal\.{flag} is 0\.1, but {why}"):
            check_config(replace(config, model=replace(config.model, feature_dim=0)))


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


def test_features_may_be_many() -> None:
    """The renderer blends any number of channels, in several traversals."""
    check_config(changed("model.feature_dim", 500))


def test_default_is_valid() -> None:
    """The schema's defaults pass."""
    check_config(TrainConfig())


@pytest.mark.parametrize(
    ("factors", "until", "expected"),
    [
        ((2.0, 4.0), (0.2, 0.5), "--resolution.factors must be above 1 and fall, found 2.0, 4.0"),
        ((2.0, 2.0), (0.2, 0.5), "--resolution.factors must be above 1 and fall"),
        ((2.0, 1.0), (0.2, 0.5), "--resolution.factors must be above 1 and fall"),
        ((4.0, 2.0), (0.5, 0.2), "--resolution.until must be shares of the run between 0 and 1 and rise, found 0.5"),
        ((4.0, 2.0), (0.5, 1.0), "--resolution.until must be shares of the run between 0 and 1"),
        ((4.0, 2.0), (0.0, 0.5), "--resolution.until must be shares of the run between 0 and 1"),
        ((4.0, float("nan")), (0.1, 0.5), "--resolution.factors must be finite"),
    ],
)
def test_sizes_of_images_must_grow(factors: tuple[float, ...], until: tuple[float, ...], expected: str) -> None:
    """Factors that fall to above 1, one after the other, and steps of full size at the end."""
    config = replace(TrainConfig(), resolution=ResolutionConfig(factors, until))
    with pytest.raises(UserError, match=re.escape(expected)):
        check_config(config)


def test_sizes_that_grow_pass() -> None:
    """One size or several."""
    for factors, until in (((2.0,), (0.5,)), ((8.0, 4.0, 1.5), (0.1, 0.2, 0.9))):
        check_config(replace(TrainConfig(), resolution=ResolutionConfig(factors, until)))
