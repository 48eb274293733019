"""Settings that there are no more: configuration files and checkpoints that have them are read.

``GONE`` also tells thermosplat-train what to say where a command line has such a flag.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from thermosplat.config.values import shown
from thermosplat.errors import UserError
from thermosplat.spectra import NOISY_SENSOR


@dataclass(frozen=True)
class Gone:
    """A setting that there is no more."""

    neutral: tuple[Any, ...]
    """Values that ask for what is done today."""
    why: str = ""
    """What is done today, in a sentence. Empty: what the first neutral value asks for."""
    shapes_images: bool = False
    """Whether a model that was trained with another value would be rendered wrongly."""

    def asks_for_today(self, value: Any) -> bool:
        """Whether a value asks for what is done today."""
        return any(value == neutral for neutral in self.neutral)

    def said(self, name: str, value: Any) -> str:
        """What to tell a user whose value is another one."""
        return f"{name} is no setting any more, found {shown(value)}. {self.why or f'It is always {self.neutral[0]}.'}"


_SOLVED = Gone((1e-3, 1e-4), "Exposures are solved for, without a learning rate.")
NOISES = ("loss_noise", "smoothness_noise", "point_spread_noise")
"""Settings of a spectrum that gave the noise of a noisy sensor, or 0 where noise did not count."""
GONE = {
    "model.rasterize_mode": Gone(
        ("classic",),
        "Scenes are trained and rendered with classic rasterization; the function rasterization has both.",
        shapes_images=True,
    ),
    "random_background": Gone((False,), "Behind a scene there is the same colour in every step: the background."),
    "spectra.*.charbonnier": Gone((0.0,), "Differences count as |d| + k d², with the k that spectra.*.squared gives."),
    "optimizer.exposures_lr": _SOLVED,
    "optimizer.exposures_lr_final": _SOLVED,
    "optimizer.opacity_offsets_lr": Gone((0.05,), "Every opacity learns at the rate optimizer.opacities_lr."),
    "optimizer.own_opacities_lr": Gone((0.05,), "Every opacity learns at the rate optimizer.opacities_lr."),
    **{
        f"optimizer.{name}": Gone((value,))
        for name, value in {
            **{"poses_lr": 1e-4, "poses_lr_final": 2.5e-6, "cameras_lr": 1.5e-3, "cameras_lr_final": 5e-6},
            "eps": 1e-15,
        }.items()
    },
    "densification.prune_large_from": Gone(
        (3000,), "Gaussians that are too large go after the first reset of opacities, densification.reset_every."
    ),
    "densification.reset_opacity": Gone((0.01,), "A reset leaves no opacity above twice densification.prune_opacity."),
    **{
        f"densification.{name}": Gone((value,))
        for name, value in {
            **{"grow_scale3d": 0.01, "prune_scale3d": 0.1, "conflict_threshold": 2e-4},
            **{"keep_opacity": 0.5, "off_opacity": 0.003},
        }.items()
    },
    "model.feature_noise": Gone((0.2,)),
    "model.init_scale": Gone((1.0,), "First scales are the root mean square distance to the 3 nearest points."),
    "decoder.hidden_layers": Gone((2,), shapes_images=True),
    "decoder.covered_only": Gone((True,), "The background shows where no Gaussian is.", shapes_images=True),
    "decoder.hybrid_bias": Gone((-4.0,)),
    **{
        f"loss.{name}": Gone((value,))
        for name, value in {"depth_spread_limit": 0.1, "depth_spread_from": 0.5, "swept_depth_limit": 0.03}.items()
    },
    **{f"spectra.*.{name}": Gone((0.0,), "Whether noise counts says spectra.*.by_noise.") for name in NOISES},
    "spectra.*.smoothness_least": Gone((0.05,)),
    "auto_budget.patience": Gone((3000, 2000), "Growth stops after twelve looks (auto_budget.validate_every)."),
    "auto_budget.spectrum_patience": Gone((1000, 670), "Four looks (auto_budget.validate_every) are waited for."),
    "auto_budget.prune_by": Gone(
        ("removal",), "A Gaussian's importance is the change of the images where it alone is left out."
    ),
    **{
        f"auto_budget.{name}": Gone((value,))
        for name, value in {
            **{"prune_change": 0.02, "offset_shrinkage": 0.02, "offset_change": 0.02, "feature_change": 0.01},
            **{"sh_change": 0.01, "rounding_change": 0.002, "measured_views": 12, "noise_floor": 1.0},
            **{"sparse_noise": 0.033, "validation_views": 2, "least_gain": 0.02, "spectrum_loss": 0.05},
            **{"few_views_until": 0.33, "fallen_views_until": 0.5, "spectrum_fall": 0.3, "held_change": 0.02},
        }.items()
    },
}
"""What became of a setting by its dotted name; ``*`` stands for any spectrum."""
_CHOICES = {"decoder_precision": ("bfloat16", "Decoders train in float32 or tf32.")}
"""Choices of settings that there are no more, and what there is."""


def gone(name: str) -> Gone | None:
    """What became of a setting; None where there is one of that name, or never was."""
    first, _, rest = name.partition(".")
    return GONE.get(f"spectra.*.{rest.partition('.')[2]}" if first == "spectra" else name)


def without_gone_settings(values: dict[str, Any], *, source: str, notes: list[str] | None = None) -> dict[str, Any]:
    """A configuration's plain values without settings that there are no more.

    Args:
        values: Nested dictionaries, from any version.
        notes: Of what is trained already: takes what to tell of settings that are left out though they asked for
            something else than what is done today. None: nothing is trained yet, and such a setting is a mistake.

    Returns:
        The same where every setting is one of today's.

    Raises:
        UserError: A setting that there is no more asks for something else than what is done today.
    """
    values = _copied(values)
    for old, change in _CHANGES.items():
        found = _taken(values, old)
        if found is not _MISSING and not change(values, found):
            _put(values, old, found)  # it never had such a value: reading the file names the key
    for by_noise in _named(values, "spectra.*.by_noise"):
        _say_by_noise(values, by_noise)
    for name, of_name in GONE.items():
        for full in _named(values, name):
            _leave_out(of_name, full, _taken(values, full), source, notes)
    for name, (choice, why) in _CHOICES.items():
        if notes is not None and values.get(name) == choice:  # in a file, reading it names the choices
            notes.append(f"{source}: {values.pop(name)} is no {name} any more. {why}")
    return values


def _named(values: dict[str, Any], name: str) -> list[str]:
    """The dotted names that a pattern of ``GONE`` stands for in some values."""
    spectra = values.get("spectra")
    return (
        [name.replace("*", each) for each in (spectra if isinstance(spectra, dict) else ())] if "*" in name else [name]
    )


def _say_by_noise(values: dict[str, Any], by_noise: str) -> None:
    """What a spectrum's thresholds of noise said, which were that of a noisy sensor, or 0; others stay as they are."""
    names = [by_noise.replace("by_noise", name) for name in NOISES]
    found = {name: value for name in names if (value := _taken(values, name)) is not _MISSING}
    for name, value in found.items():
        if value not in (0.0, NOISY_SENSOR):
            _put(values, name, value)
    if any(value in (0.0, NOISY_SENSOR) for value in found.values()):
        _put(values, by_noise, NOISY_SENSOR in found.values())


def _leave_out(gone: Gone, name: str, value: Any, source: str, notes: list[str] | None) -> None:
    if value is _MISSING or gone.asks_for_today(value):
        return
    if notes is not None and not gone.shapes_images:
        notes.append(f"{source}: {gone.said(name, value)}")
        return
    raise UserError(
        f"{source}: {gone.said(name, value)}", "Leave it out." if source[:2] == "--" else "Remove the line."
    )


Change = Callable[[dict[str, Any], Any], bool]
"""Takes the values and an old value out of them, sets today's; returns whether it is a value that there was."""


def _reset(values: dict[str, Any], opacity: Any) -> bool:
    densification = values.get("densification", {})
    pruned = densification.get("prune_opacity") if isinstance(densification, dict) else None
    return isinstance(pruned, float) and opacity == 2 * pruned


def _same_rate(values: dict[str, Any], rate: Any) -> bool:
    optimizer = values.get("optimizer", {})
    return isinstance(optimizer, dict) and rate == optimizer.get("opacities_lr")


_CHANGES: dict[str, Change] = {
    "optimizer.opacity_offsets_lr": _same_rate,
    "optimizer.own_opacities_lr": _same_rate,
    "densification.reset_opacity": _reset,
}
"""Settings whose values say something else today, or the same as another one."""

_MISSING = object()


def _copied(value: Any) -> Any:
    return {key: _copied(item) for key, item in value.items()} if isinstance(value, dict) else value


def _taken(values: dict[str, Any], name: str) -> Any:
    """The value of a dotted name, which is removed; ``_MISSING`` where there is none."""
    *groups, key = name.split(".")
    inner: Any = values
    for group in groups:
        inner = inner.get(group) if isinstance(inner, dict) else None
    if not isinstance(inner, dict) or key not in inner:
        return _MISSING
    found = inner.pop(key)
    if len(groups) == 1 and not inner:  # a group of old names
        values.pop(*groups)
    return found


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    """Set the value of a dotted name, unless it has one or what should be a group of settings is something else."""
    *groups, key = name.split(".")
    for group in groups:
        values = values.setdefault(group, {})
        if not isinstance(values, dict):
            return
    values.setdefault(key, value)
