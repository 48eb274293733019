"""Formations of a checkpoint: every parameter is held against the configuration before any is used."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from thermosplat.config import DecoderConfig, ModelConfig
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.spectra import Spectrum, SpectrumConfig

Saved = Mapping[str, Tensor] | None
"""Parameters by name, of this version or an older one; None: there are none."""

_WIDTHS = "point_spreads.log_widths."
"""Begin of the names of blurs' parameters up to version 0.2, which had them beside the decoder's."""


def restored_formations(
    saved: Saved, model: ModelConfig, decoding: DecoderConfig, spectra: Sequence[Spectrum]
) -> Formations:
    """The formations of a scene as a checkpoint has them. The arguments are those of ``Formations``.

    Raises:
        ValueError: A parameter is missing, or of another shape; said before memory is taken for what is asked for.
        RuntimeError: There are more than that.
    """
    found = _by_todays_names(saved)
    with torch.device("meta"):
        asked = Formations(model, decoding, spectra).state_dict()
    shapes = {name: list(value.shape) for name, value in found.items()}
    for name, value in asked.items():
        if shapes.get(name) != list(value.shape):
            raise ValueError(f"formations.{name} has the shape {shapes.get(name)}, not {list(value.shape)}")
    formations = Formations(model, decoding, spectra)
    formations.load_state_dict(found)
    return formations


def as_trained(spectra: Mapping[str, SpectrumConfig], saved: Saved) -> dict[str, SpectrumConfig]:
    """The spectra by name with the blur that a saved scene has, or has not: noise decides no more."""
    found, trained = _by_todays_names(saved), dict(spectra)
    for name, one in spectra.items():
        if one.by_noise:
            width = one.point_spread if _width_of(name) in found else 0.0
            trained[name] = replace(one, point_spread=width)
    return trained


def _width_of(spectrum: str) -> str:
    return f"by_spectrum.{spectrum}.point_spread.log_width"


def _by_todays_names(saved: Saved) -> dict[str, Tensor]:
    def renamed(name: str) -> str:
        if name.startswith(("decoder.", "by_spectrum.")):
            return name
        return _width_of(name.removeprefix(_WIDTHS)) if name.startswith(_WIDTHS) else f"decoder.{name}"

    return {renamed(name): value for name, value in (saved or {}).items()}
