"""Checkpoints of version 0.1 as today's: it knew two spectra, RGB and thermal, by name."""

from itertools import compress
from typing import Any

from thermosplat.spectra import CELSIUS

OLD_FORMAT = 1
OLD_REQUIRED = ("step", "config", "sh_degree", "model", "thermal_scale", "training")
"""What a checkpoint of that format must have."""

_DECODER_NAMES = {
    "thermal_prior.": "priors.thermal.",
    "modulation.": "modulations.rgb.",
    "rgb_head.": "heads.rgb.",
    "thermal_head.": "heads.thermal.",
    "rgb_network.": "networks.rgb.",
    "thermal_network.": "networks.thermal.",
}
"""Begin of the names of decoders' parameters: then and now."""
_GREY = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]


def as_today(state: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint of format 1 in today's format.

    Args:
        state: The checkpoint, with all that format 1 has.

    Raises:
        KeyError, TypeError, AttributeError: It is damaged.
    """
    model, training = dict(state["model"]), dict(state["training"])
    channels = model.pop("thermal_channels")
    model["color_spaces"] = {"rgb": "photograph", "thermal": "scalar" if channels == 1 else "color"}
    modelled = state["config"].get("model", {})
    names = [name for name in ("rgb", "thermal") if modelled.get(name, True)]
    optimizers = training.get("optimizers")
    if model["decoders"] is not None:
        unused = tuple(
            f"{part}.{name}." for part in ("heads", "modulations") for name in ("rgb", "thermal") if name not in names
        )
        renamed = dict(map(_renamed, model["decoders"].items()))
        kept = [not name.startswith(unused) for name in renamed]
        model["decoders"] = dict(compress(renamed.items(), kept))
        if optimizers is not None:
            optimizers = optimizers | {"decoders": {"decoders": _of_some(optimizers["decoders"]["decoders"], kept)}}
    if training.get("exposures") is not None:
        kept = [name in names for name in training["exposures"]]
        training["exposures"] = {f"maps.{name}": value for name, value in compress(training["exposures"].items(), kept)}
        if optimizers is not None:
            optimizers = optimizers | {"exposures": {"exposures": _of_some(optimizers["exposures"]["exposures"], kept)}}
    training["optimizers"] = optimizers
    scales = {"rgb": {"kind": "photograph", "palette": _GREY, "range": None, "unit": None}}
    if state["thermal_scale"] is not None:
        scales["thermal"] = state["thermal_scale"] | {"unit": CELSIUS}
    today = {key: value for key, value in state.items() if key != "thermal_scale"}
    return today | {"format": OLD_FORMAT + 1, "model": model, "training": training, "scales": scales}


def _of_some(optimizer: dict[str, Any], kept: list[bool]) -> dict[str, Any]:
    """An optimizer's state with the parameters alone that are kept, in their order."""
    (group,) = optimizer["param_groups"]
    numbers = list(compress(group["params"], kept))
    state = {place: optimizer["state"][number] for place, number in enumerate(numbers) if number in optimizer["state"]}
    return {"state": state, "param_groups": [group | {"params": list(range(len(numbers)))}]}


def _renamed(entry: tuple[str, Any]) -> tuple[str, Any]:
    name, value = entry
    for old, new in _DECODER_NAMES.items():
        if name.startswith(old):
            return new + name.removeprefix(old), value
    return entry
