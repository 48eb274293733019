"""Settings that version 0.1 had under other names: its configuration files and checkpoints are read as today's.

``NEW_NAMES`` also tells thermosplat-train what to say where a command line has an old flag.
"""

from collections.abc import Callable
from typing import Any

NEW_NAMES = {
    "thermal.source": "spectra.thermal.source",
    "thermal.unit": "spectra.thermal.unit",
    "thermal.range_celsius": "spectra.thermal.range",
    "thermal.palette": "spectra.thermal.palette",
    "thermal.aligned": "spectra.thermal.aligned",
    "model.thermal_opacity": "spectra.thermal.opacity",
    "model.thermal_start": "spectra.thermal.start",
    "schedule.thermal_from": "spectra.thermal.train_from",
    "schedule.rgb_until": "spectra.rgb.train_until",
    "loss.rgb": "spectra.rgb.loss",
    "loss.thermal": "spectra.thermal.loss",
    "loss.features_rgb": "spectra.rgb.features",
    "loss.features_thermal": "spectra.thermal.features",
    "loss.thermal_smoothness": "spectra.thermal.smoothness",
    "loss.thermal_smoothness_noise": "spectra.thermal.smoothness_noise",
    "loss.thermal_smoothness_least": "spectra.thermal.smoothness_least",
    "loss.thermal_charbonnier": "spectra.thermal.charbonnier",
    "decoder.hybrid_rgb": "decoder.hybrid",
    "decoder.rgb_head_bias": "decoder.hybrid_bias",
    "optimizer.thermal_opacity_offsets_lr": "optimizer.opacity_offsets_lr",
    "optimizer.thermal_opacities_lr": "optimizer.own_opacities_lr",
    "optimizer.thermal_sh0_lr": "optimizer.sh0_lr",
    "optimizer.thermal_shN_lr": "optimizer.shN_lr",
}
"""Dotted name of a setting today by the one it had."""


def with_todays_names(values: dict[str, Any]) -> dict[str, Any]:
    """A configuration's plain values under today's names.

    Args:
        values: Nested dictionaries, from any version.

    Returns:
        The same where every name is today's. A value that is there under both names is today's.
    """
    values = _copied(values)
    for old, change in _CHANGES.items():
        found = _taken(values, old)
        if found is not _MISSING and not change(values, found):
            _put(values, old, found)  # it never had such a value: reading the file names the key
    for old, new in NEW_NAMES.items():
        found = _taken(values, old)
        if found is not _MISSING:
            _put(values, new, found)
    return values


Change = Callable[[dict[str, Any], Any], bool]
"""Takes the values and an old value out of them, sets today's; returns whether it is a value that there was."""


def _modelled(name: str) -> Change:
    def change(values: dict[str, Any], modelled: Any) -> bool:
        without = values.setdefault("without", [])
        if modelled is False and isinstance(without, list) and name not in without:
            values["without"] = [*without, name]
        return isinstance(modelled, bool)

    return change


def _decoupled(values: dict[str, Any], decoupled: Any) -> bool:
    stored = _taken(values, "model.thermal_opacity")
    if decoupled is False:
        _put(values, "spectra.thermal.opacity", "shared")
    else:
        _put(values, "spectra.thermal.opacity", "offset" if stored is _MISSING else stored)
    return isinstance(decoupled, bool)


def _decomposed(values: dict[str, Any], threshold: Any) -> bool:
    if threshold is None:
        _put(values, "densification.strategy", "default")
        return True
    _put(values, "densification.conflict_threshold", threshold)
    if values["densification"].get("strategy", "default") == "default":
        values["densification"]["strategy"] = "decomposing"
    return True


def _exposed(values: dict[str, Any], exposed: Any) -> bool:
    if exposed is True:
        for spectrum in ("rgb", "thermal"):
            _put(values, f"spectra.{spectrum}.exposure", "affine")
    return isinstance(exposed, bool)


_CHANGES: dict[str, Change] = {
    "model.exposures": _exposed,
    "model.rgb": _modelled("rgb"),
    "model.thermal": _modelled("thermal"),
    "model.geometric_decoupling": _decoupled,
    "densification.decompose_threshold": _decomposed,
}
"""Settings whose values say something else today."""

_MISSING = object()


def _copied(value: Any) -> Any:
    return {key: _copied(item) for key, item in value.items()} if isinstance(value, dict) else value


def _taken(values: dict[str, Any], name: str) -> Any:
    """The value of a dotted name, which is removed; ``_MISSING`` where there is none."""
    group, _, key = name.rpartition(".")
    inner = values.get(group)
    if not isinstance(inner, dict) or key not in inner:
        return _MISSING
    found = inner.pop(key)
    if not inner:
        values.pop(group)
    return found


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    """Set the value of a dotted name, unless it has one or what should be a group of settings is something else."""
    *groups, key = name.split(".")
    for group in groups:
        values = values.setdefault(group, {})
        if not isinstance(values, dict):
            return
    values.setdefault(key, value)
