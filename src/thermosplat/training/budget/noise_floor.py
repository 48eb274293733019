"""Losses that do not ask for less than noise: what a view's error is made of when it is as small as its noise.

The squared error of a true render of the scene is the variance σ² of the images' noise. A training that goes below it
has begun to learn the noise of its views, which no other view has. So where the squared error of a view, in a spectrum,
is below a share of σ², its losses in that spectrum have no gradient in this step; they have one again as soon as the
error rises. The other spectra of the view are trained on as before. (The discrepancy principle of Morozov 1966, view by
view; Ishida et al. 2020 hold a loss at a level by the sign of its gradient.) Floors rise where withheld views say so
(noise_watch.py).
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from thermosplat.config import TrainConfig
from thermosplat.losses.image_terms import ComparedFrame
from thermosplat.spectra import label
from thermosplat.training.budget.tolerances import TOLERANCES
from thermosplat.training.sensor_facts import SensorFacts


def noise_floors(
    config: TrainConfig, facts: SensorFacts, share: float = TOLERANCES.noise_floor
) -> tuple[dict[str, float], tuple[str, ...]]:
    """The squared errors below which views are not fitted: with ``--budget auto``.

    Args:
        facts: The noise of each spectrum's training images.
        share: Of its variance.

    Returns:
        Squared errors by spectrum, more than 0, of the spectra whose images have noise; and what to tell the user.
    """
    floors, notes = {}, []
    for name in config.modelled if config.budget == "auto" and share > 0 else ():
        noise = facts.noise(name)
        if noise is None or noise.plain == 0:
            continue
        floors[name] = share * noise.plain**2
        limit = -10.0 * math.log10(floors[name])
        notes.append(
            f"Noise of the {label(name)} images at least {noise.plain:.4f} of the range: training views are fitted up "
            f"to {limit:.1f} dB."
        )
    return floors, tuple(notes)


def gradient_shares(compared: ComparedFrame, floors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What the gradients of a frame's loss terms are multiplied by; nothing here waits for the device.

    Args:
        compared: The rendered frame against its images.
        floors: The frame's squared errors by spectrum below which it is not fitted, scalars.

    Returns:
        float32 scalars by term, 1 where the error of its spectrum is above the floor, else 0; of spectra with a floor.
    """
    above = {
        name: (error > floors[name]).to(torch.float32)
        for name, error in compared.squared_errors.items()
        if name in floors
    }
    return {term: above[name] for term, name in compared.spectra.items() if name in above}
