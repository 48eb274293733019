"""What a configuration must satisfy beyond its types: ranges, and settings that exclude each other."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

from thermosplat.config import OF_FRAMES, TrainConfig
from thermosplat.config.run_schedule import scaled_steps
from thermosplat.config.schema import SPLIT_APART_MOST
from thermosplat.config.spectrum_checks import check_spectra
from thermosplat.config.values import shown
from thermosplat.errors import UserError
from thermosplat.spectra import label, latent_channels
from warp_kernels.constants import SH_DEGREE_MAX

_AT_LEAST: dict[str, float] = {
    "max_steps": 1,
    "steps_for_views": 1,
    "noisy_steps": 1,
    "scenes": 1,
    "batch_size": 1,
    "data_factor": 1,
    "test_every": 2,
    "sh_degree": 0,
    "log_every": 1,
    "refine_rounds_from": 0,
    "refine_every": 1,
    "refine_first": 0,
    "seed": 0,
    "model.feature_dim": 0,
    "model.eps2d": 0,
    "decoder.hidden_dim": 1,
    "decoder.padding": 0,
    "decoder.fourier_frequency": 0,
    "densification.max_gaussians": 1,
    "densification.growth": 0,
    "densification.split_apart": 0,
    "resolution.growth_power": 0,
    "densification.position_noise": 0,
    "densification.grad_threshold": 0,
}
_STEPS = {
    "sh_degree_interval": 1,
    "refine_from": 0,
    "densification.start_step": 0,
    "densification.stop_step": 0,
    "densification.every": 1,
    "densification.reset_every": 1,
    "auto_budget.validate_every": 1,
}
"""Least number of steps where a schedule is given in steps, not as a share of the run."""
_AT_MOST: dict[str, float] = {
    "densification.split_apart": SPLIT_APART_MOST,
    "max_steps": 10**8,
    "seed": 2**63 - 1,  # what torch's generators take
    "sh_degree": SH_DEGREE_MAX,  # what the renderer's kernels evaluate
    "decoder.hidden_dim": 65_536,  # far beyond what trains; more only fills the memory
}
_LARGEST_INTEGER = 10**12
"""Far beyond any count of steps, images or Gaussians; sums and products of such numbers stay below 2^63."""
_LEAST_FLOAT, _LARGEST_FLOAT = 1e-30, 1e30
"""float32, in which all of it is computed, has numbers from 1e-38 to 3e38."""
_LEAST_SHARE = 1e-9
"""Of the run, where there must be a step: of 10^8, the longest run, a tenth of one."""
_SHARES = ("loss.ssim_lambda", "optimizer.cooldown_from")
_POSITIVE = (
    "steps_scaler",
    "image_memory",
    "gpu_memory",
    "optimizer.means_lr_final",
    "optimizer.features_lr_final",
    "optimizer.decoders_lr_final",
    "optimizer.final_share",
    "refine_rates",
)


def check_config(config: TrainConfig, *, source: str = "") -> None:
    """Look for values that no run can work with.

    Args:
        source: File it was read from; empty for the command line, whose flags are then named.

    Raises:
        UserError: A value out of range, or two settings that exclude each other; names it, its value and the bound.
    """
    values = dict(flattened(config))

    def name(key: str) -> str:
        return f"{source}: {key}" if source else "--" + key.removeprefix("spectra.").replace("_", "-")

    for key, value in values.items():
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise UserError(f"{name(key)} must be finite, found {number}.")
            if isinstance(number, float) and number and not _LEAST_FLOAT <= abs(number) <= _LARGEST_FLOAT:
                bounds = f"{_LEAST_FLOAT:g} and {_LARGEST_FLOAT:g}"
                raise UserError(f"{name(key)} must be 0 or between {bounds} in size, found {number}.")
        check_text(value, name(key))
    for key, least in _AT_LEAST.items():
        if values[key] is not None and values[key] < least:
            raise UserError(f"{name(key)} must be at least {least}, found {shown(values[key])}.")
    for key, most in _AT_MOST.items():
        if values[key] > most:
            raise UserError(f"{name(key)} must be at most {most}, found {shown(values[key])}.")
    for key, least in _STEPS.items():
        steps = values[key]
        if not (steps >= least if isinstance(steps, int) else 0 <= steps <= 1 and steps >= least * _LEAST_SHARE):
            raise UserError(
                f"{name(key)} must be at least {least} as steps, which are a whole number, or between 0 and 1 as a "
                f"share of the run, found {shown(steps)}."
            )
    for key, value in values.items():
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int) and abs(number) > _LARGEST_INTEGER and key != "seed":
                raise UserError(f"{name(key)} must be at most {_LARGEST_INTEGER:,}, found {shown(number)}.")
    if isinstance(config.image_size, int) and config.image_size < 1:
        raise UserError(f"{name('image_size')} must be at least 1 or auto, found {config.image_size}.")
    for key in _SHARES:
        if not 0 <= values[key] <= 1:
            raise UserError(f"{name(key)} must lie between 0 and 1, found {values[key]}.")
    for key in _POSITIVE:
        if values[key] is not None and not values[key] > 0:
            raise UserError(f"{name(key)} must be positive, found {values[key]}.")
    for key, value in values.items():
        if key.startswith(("loss.", "optimizer.")) and value < 0:
            raise UserError(f"{name(key)} must be zero or positive, found {value}.")
    for key in ("eval_steps", "save_steps"):
        if any(step < 1 for step in values[key]):
            raise UserError(f"{name(key)} must be steps from 1 on, found {list(values[key])}.")
    for key, most in (("model.init_opacity", 1.0), ("densification.prune_opacity", 0.5)):  # once and twice are logits
        if not 0 < values[key] < most:
            raise UserError(f"{name(key)} must lie between 0 and {most:g}, found {values[key]}.")
    if not all(0 <= channel <= 1 for channel in config.background):
        raise UserError(f"{name('background')} must be three values between 0 and 1, found {config.background}.")
    check_spectra(config, name)
    _check_model(config, name)
    if config.decoder.branches == "separate" and config.decoder.modulation:
        raise UserError(
            f"{name('decoder.branches')} separate leaves nothing to modulate one spectrum by the other with.",
            f"Switch {name('decoder.modulation')} off too.",
        )
    if "rig" in config.refine and len(config.modelled) < 2:
        raise UserError(f"{name('refine')} rig corrects how cameras stand to each other, and one spectrum is modelled.")
    _check_camera_passes(config, name)
    _check_scenes(config, name)
    _check_resolution(config, name)
    _check_decomposition(config, name)
    if not all(0 < share < 1 for share in config.auto_budget.prune_at):
        shares = config.auto_budget.prune_at
        raise UserError(f"{name('auto_budget.prune_at')} must be shares of the run between 0 and 1, found {shares}.")


def check_text(value: object, what: str) -> None:
    """Refuse the name of a file that a configuration cannot hold.

    Args:
        value: Any value; only texts and paths are looked at.

    Raises:
        UserError: It has bytes that are no UTF-8, or what OmegaConf would fill in.
    """
    text = str(value)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UserError(f"{what} is {text}, which is not UTF-8.", "Rename that file or folder.") from error
    if "${" in text:
        raise UserError(f"{what} is {text}, and no configuration can hold ${{.", "Rename that file or folder.")


def _check_camera_passes(config: TrainConfig, name: Any) -> None:
    """Passes that find cameras must be long enough for a round."""
    between_cameras = [kind for kind in config.refine if kind not in OF_FRAMES]
    steps = min(config.refine_first, scaled_steps(config.max_steps, config.steps_scaler))
    begin = config.refine_rounds_from + config.refine_every
    if not between_cameras or len(config.modelled) < 2 or not 0 < steps < begin:
        return
    limit = name("refine_first" if steps == config.refine_first else "max_steps")
    raise UserError(
        f"{name('refine')} {' '.join(between_cameras)} finds cameras in passes of {steps:,} steps ({limit}), and would "
        f"begin at step {begin:,}.",
        f"Lower {name('refine_rounds_from')} and {name('refine_every')}, or raise {limit}.",
    )


def _check_scenes(config: TrainConfig, name: Any) -> None:
    """Scenes become one where rates begin to fall."""
    joined_from = config.optimizer.cooldown_from
    if config.scenes > 1 and not 0 < joined_from < 1:
        raise UserError(
            f"{name('scenes')} {config.scenes} become one at {name('optimizer.cooldown_from')}, which must lie between "
            f"0 and 1, found {joined_from}.",
            "0.8 leaves them a fifth of the steps.",
        )


def _check_resolution(config: TrainConfig, name: Any) -> None:
    """Smaller images come first, each size for a share of the run."""
    factors, until = config.resolution.factors, config.resolution.until
    if len(factors) != len(until):
        raise UserError(
            f"{name('resolution.factors')} and {name('resolution.until')} belong together, one share of the run for "
            f"each factor, found {len(factors)} and {len(until)}."
        )
    if list(factors) != sorted(set(factors), reverse=True) or not all(factor > 1 for factor in factors):
        raise UserError(
            f"{name('resolution.factors')} must be above 1 and fall, found {', '.join(map(str, factors))}.",
            "For example 4 and then 2; the steps after them have images of full size.",
        )
    if list(until) != sorted(set(until)) or not all(0 < share < 1 for share in until):
        raise UserError(
            f"{name('resolution.until')} must be shares of the run between 0 and 1 and rise, found "
            f"{', '.join(map(str, until))}.",
            "The last share must leave steps at full size.",
        )


def _check_model(config: TrainConfig, name: Any) -> None:
    model = config.model
    latent = latent_channels(config.modelled)
    needed = max(last for _, last in latent.values())
    if 0 < model.feature_dim < needed:
        channels = ", ".join(
            f"{_channels(*ends)} with {label(spectrum)}" for spectrum, ends in latent.items() if ends[0] < ends[1]
        )
        raise UserError(
            f"{name('model.feature_dim')} must be 0 or at least {needed}, found {model.feature_dim}: "
            f"losses supervise {channels}.",
            "More channels make room; a spectrum with features: null needs none.",
        )
    if model.gaussian_sets == "separate" and model.feature_dim:
        raise UserError(
            f"Separate Gaussians have no shared features, but {name('model.feature_dim')} is {model.feature_dim}.",
            "Set it to 0, as --config 3dgs does.",
        )
    for field, (value, why) in _needing_features(config).items():
        if value > 0 and not model.feature_dim:
            raise UserError(
                f"{name(field)} is {value}, but {why}, and {name('model.feature_dim')} is 0.",
                "Leave it at 0.",
            )
    separate = model.gaussian_sets == "separate" and len(config.modelled) > 1
    if config.loss.balance and not separate:
        raise UserError(f"{name('loss.balance')} is about separate sets of Gaussians, one per spectrum.")


def _needing_features(config: TrainConfig) -> dict[str, tuple[float, str]]:
    """Settings that only models with latent features know: their values, and why that is so."""
    blended, blurred = "depths are blended with features", "blur is of features"
    found = {"loss.depth_spread": (config.loss.depth_spread, blended)}
    for spectrum, one in config.modelled.items():
        found[f"spectra.{spectrum}.swept_depth"] = one.swept_depth, blended
        found[f"spectra.{spectrum}.point_spread"] = one.point_spread, blurred
    return found


def _channels(first: int, beyond: int) -> str:
    return f"channel {first}" if beyond == first + 1 else f"channels {first} to {beyond - 1}"


def _check_decomposition(config: TrainConfig, name: Any) -> None:
    model, densification = config.model, config.densification
    if densification.strategy != "decomposing":
        return
    modelled = list(config.modelled.values())
    others = modelled[1:]
    if not (model.gaussian_sets == "shared" and others and all(other.opacity == "own" for other in others)):
        raise UserError(
            f"{name('densification.strategy')} decomposing divides Gaussians between spectra, which needs a shared set "
            "of at least two, each with an opacity of its own.",
            "Start from --config mmone, or take another strategy.",
        )
    if densification.absgrad:
        raise UserError(
            f"{name('densification.strategy')} decomposing compares directions, which "
            f"{name('densification.absgrad')} does not keep.",
            "Leave one of them out.",
        )


def flattened(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of all settings, of every spectrum, too.

    Args:
        config: A configuration, or a group of one.
        prefix: What comes before the names.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from flattened(value, f"{prefix}{field.name}.")
        elif isinstance(value, dict):
            for name, group in value.items():
                yield from flattened(group, f"{prefix}{field.name}.{name}.")
        else:
            yield f"{prefix}{field.name}", value
